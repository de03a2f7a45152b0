"""Complete actors from few observations: what is observed, how it is completed, and how near that comes to truth."""
