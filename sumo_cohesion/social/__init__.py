"""Social: who (groups), what (features) and when (agreement) to follow."""
