"""The long tasks of a process: what becomes of one that raises."""
