"""A synthetic city in PandaSet format, with the truth beside it."""
