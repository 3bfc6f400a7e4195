"""Ray-traced samples: a meso-structure, its materials, and a measurement of it."""
