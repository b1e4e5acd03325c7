"""The thesis's printed tables and figures, and ours joined to them."""
