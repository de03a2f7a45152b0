"""The generative prior over asset codes: a diffusion model in the latent space of a library (paper section 3.3)."""
