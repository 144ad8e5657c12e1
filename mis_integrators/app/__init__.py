"""The command ``mis-render``: options, the loop of a render, checkpoints, clusters, what is
written."""
