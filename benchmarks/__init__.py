"""Throughput scripts; see ``README.md`` beside this file."""
