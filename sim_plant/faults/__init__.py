"""Faults by name: what can go wrong on the simulated line, how it is asked for, and what it does."""
