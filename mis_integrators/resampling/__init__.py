"""Light sub-paths drawn anew for each camera vertex: cache points, probabilities, draws."""
