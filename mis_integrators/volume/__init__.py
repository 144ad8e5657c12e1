"""Media along a line of sight: sections, shifts between segments, transmittance, volumetric paths,
views."""
