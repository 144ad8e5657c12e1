"""What experiments and report both need: scenes, methods, references, measured renders, rows."""
