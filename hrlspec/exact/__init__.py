"""Exact solutions: product automata, dynamic programming, and reference agents that know the map."""
