"""One run: a scenario, its cars, the loop, and the record that it leaves."""
