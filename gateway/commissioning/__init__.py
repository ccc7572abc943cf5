"""Commissioning: the phases, their algorithms, and the rule policy that decides when nobody else does. Pure."""
