"""Zone: the world, its physics, and its layouts."""
