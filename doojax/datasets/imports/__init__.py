"""Data sets of trajectories that others made, or that doojax exported: `doojax import`."""
