"""Sub-paths of light and camera, their vertices, and how they are joined. They know no theory of
weights."""
