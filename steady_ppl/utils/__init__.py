"""What any program of this size needs, and nothing that knows of vehicles: files, text, random streams, progress."""
