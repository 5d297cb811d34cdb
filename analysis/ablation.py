"""What each addition to the printed formula is worth: the default with one piece taken out.

    python -m analysis.ablation [--seeds 2000:2010] [--workers 2]

Writes analysis/ablation.csv and analysis/ablation.json. The seeds are neither those the pieces
were chosen on (1000 to 1999) nor those the claims are reported on.
"""

from __future__ import annotations

from analysis.study import Changes, study

PIECES: Changes = {
    "default": {},
    "drivers have no habits": {"cohesion.habit": 0.0},
    "speed weighs as much as steering": {"cohesion.speed_weight": 1.0},
    "no place across the road": {"cohesion.place_weight": 0.0},
    "a surprise is forgotten at once": {"cohesion.surprise_hold": 0.0},
    "no need of a surprise": {"cohesion.surprise": 0.0},
    "all groups steer": {"cohesion.lateral_votes": "all"},
}
SCENARIOS = ("stalled_swerve", "ambulance", "nothing_to_follow")

if __name__ == "__main__":
    study("ablation", PIECES, SCENARIOS, "2000:2010")
