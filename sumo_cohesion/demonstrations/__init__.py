"""Where examples of driving come from: runs and batches, SUMO's own output, tables, CommonRoad."""
