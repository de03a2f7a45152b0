"""Measures of how well rendered actors agree with held-out images and known shapes."""
