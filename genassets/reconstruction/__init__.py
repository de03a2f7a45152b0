"""Latents, decoder and fields learned from driving logs through occlusion-aware rendering."""
