"""The plugins: one file each. Import through `mis_integrators`, which registers them for the active
variant."""
