"""``python -m sumo_cohesion`` is the command line."""

from sumo_cohesion.cli import main

if __name__ == "__main__":
    main()
