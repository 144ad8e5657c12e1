"""What measures: a module a sub-command of `run.py`, and the scenes that they vary."""
