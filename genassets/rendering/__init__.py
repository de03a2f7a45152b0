"""Ragged, culled sampling along rays, compositing in depth order, and the camera's image network."""
