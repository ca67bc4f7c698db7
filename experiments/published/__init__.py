"""Comparison with what others have published: which agents on which formulas, records of evaluations, and the page."""
