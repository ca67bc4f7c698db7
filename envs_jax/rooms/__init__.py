"""Rooms: the world, and how many steps its two orders of going take."""
