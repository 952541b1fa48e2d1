"""Tensors and a little text in one safetensors file, written beside and renamed. Never pickle."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from steady_ppl.errors import RunError
from steady_ppl.utils.files import require_file, whole_file

HASH = "sha256"  # of tensors and text, in the file's own text


def packed(tensors: Mapping[str, Tensor], text: Mapping[str, str]) -> bytes:
    """Tensors and text in the form of such a file, without a hash."""
    return save({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, dict(text))


def unpacked(content: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and text of such a file; SafetensorError where it is none."""
    tensors = load(content)
    header = content[8 : 8 + int.from_bytes(content[:8], "little")]  # whose length comes first
    return tensors, json.loads(header).get("__metadata__") or {}


def write_tensors(path: Path, tensors: Mapping[str, Tensor], text: Mapping[str, str] | None = None) -> None:
    """Write tensors and text to a safetensors file, whole or not at all, with their hash, by which damage is told."""
    text = text or {}
    with whole_file(path, RunError) as beside:
        beside.write_bytes(packed(tensors, {**text, HASH: _hash(tensors, text)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a file of `write_tensors`, or one without a hash in it; RunError where it is missing or damaged."""
    require_file(path, RunError)
    try:
        tensors, text = unpacked(path.read_bytes())  # not by name: safetensors reads none that is not UTF-8
    except FileNotFoundError:
        raise RunError(f"no file {path.name} in {path.parent}") from None
    except SafetensorError as error:
        raise damaged(path, str(error)) from error
    except OSError as error:
        raise RunError(f"{path.name} in {path.parent} cannot be read: {error.strerror or error}") from error
    if (written := text.pop(HASH, None)) is not None and written != _hash(tensors, text):
        raise damaged(path, "its numbers are not those that were written")
    return tensors, text


def _hash(tensors: Mapping[str, Tensor], text: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(sorted(text.items())).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode(errors="surrogatepass"))
        digest.update(value.detach().contiguous().reshape(-1).view(torch.uint8).numpy(force=True).tobytes())
    return digest.hexdigest()


def damaged(path: Path, why: str) -> RunError:
    """The error to raise for a file of a run that is not what was written."""
    return RunError(f"{path.name} in {path.parent} is damaged ({why})")
