"""Zone: the world, its contested layouts and its pictures."""
