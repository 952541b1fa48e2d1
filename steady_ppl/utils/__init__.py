"""What any program of this size needs, and nothing that knows of vehicles: files, text, random streams, progress.

A module here imports `steady_ppl.errors` and its neighbours, and no other package.
"""
