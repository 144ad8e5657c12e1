"""The pilot that chooses merge radii: its statistics, and the iterations that it renders."""
