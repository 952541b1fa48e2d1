"""What a program is and how it is run: its form, its sites, its step. Nothing here infers anything."""
