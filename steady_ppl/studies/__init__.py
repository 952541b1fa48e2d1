"""Studies: grids of independent jobs, on local processes or a Dask cluster, whose results are one Parquet table.

`plan.py` reads what is compared with what from a TOML file, `job.py` computes one cell of that grid, `table.py` keeps
what has come in, `runner.py` sends jobs out, `pictures.py` draws.
"""
