"""Studies: grids of independent jobs, on local processes or a Dask cluster, whose results are one Parquet table.

`study_file.py` reads what is compared with what from TOML into a `plan.py`, `job.py` computes one cell of that grid,
`table.py` keeps what has come in, `runner.py` sends jobs out, `pictures.py` draws.
"""
