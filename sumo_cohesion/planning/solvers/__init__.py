"""The solvers of the planning problem, and the controller that calls them."""

SOLVERS = {
    "ilqr": "ilqr:Ilqr",
    "fatrop": "nlp:fatrop",
    "ipopt": "nlp:ipopt",
    "lbfgs": "lbfgs:Lbfgs",
}
"""Solvers by the name that ``planner.solver`` takes: module of this folder, and what makes one of
(settings, number of lanes)."""
