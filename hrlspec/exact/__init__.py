"""Exact answers: product automata, dynamic programming, and agents that know the map."""
