"""A fit as a thing that is kept: its folder, its recipe, what it predicts and what is to be doubted of it."""
