"""Planning: how to trade the ego's own reward against cohesion."""
