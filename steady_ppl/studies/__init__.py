"""Studies: grids of independent jobs, on local processes or a Dask cluster, whose results are one Parquet table.

`study_file.py` reads what is compared with what from TOML into a `plan.py`, `job.py` computes one cell of that grid,
`places.py` says where, `runner.py` sends jobs there, `table.py` keeps what has come in, `pictures.py` draws.
"""
