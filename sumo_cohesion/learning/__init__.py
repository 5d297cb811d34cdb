"""Learn the reward weights theta from driving, by continuous inverse optimal control."""
