"""Parts of pages that show one estimate of a room, with the truth where it is known."""
