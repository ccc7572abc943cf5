"""Phases 0 and 4: what the line's own data say about its physics, and how sure they are of it. Pure."""
