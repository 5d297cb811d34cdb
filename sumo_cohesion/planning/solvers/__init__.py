"""The solvers of the planning problem, and the controller that calls them."""
