"""Traffic: the only room that imports SUMO; its conventions stop here."""
