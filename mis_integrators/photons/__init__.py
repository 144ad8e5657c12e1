"""Photon maps: the grid, gathering in it, the edges of merge disks, the irradiance cache."""
