"""Report: figures, made of saved tables only."""
