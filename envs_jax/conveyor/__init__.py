"""Conveyor: two corridors that differ in their last item alone, and belts that let nobody back."""
