"""Instance masks of actors: box prompts, segmenters, and their agreement with the LiDAR."""
