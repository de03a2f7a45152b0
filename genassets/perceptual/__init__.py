"""Networks that judge how alike images look."""
