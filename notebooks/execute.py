"""Run notebooks and keep their outputs: python notebooks/execute.py notebooks/*.ipynb

Warnings of the machine at hand (stderr) are left out.
"""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

for name in sys.argv[1:]:
    notebook = nbformat.read(name, as_version=4)
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(Path(name).parent)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    nbformat.write(notebook, name)
