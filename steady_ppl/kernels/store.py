"""Machine code of kernels, kept on disk between commands.

LLVM takes tens of milliseconds and more for a kernel; to load its machine code takes one. What is loaded runs with all
rights of the user, so that it is kept only where nobody else can write, and loaded only if its digest is right. The
folder is `steady-ppl/kernels` in the user's cache folder, or what the environment variable `STEADY_KERNEL_CACHE` names;
"off" keeps nothing. Where nothing can be kept, every command compiles anew: that is no error.
"""

import os
import re
import secrets
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import llvmlite
import numba
from llvmlite import binding

ENVIRONMENT_VARIABLE = "STEADY_KERNEL_CACHE"
MAX_BYTES = 64 * 2**20  # bytes of all files; the least recently used ones go
USE_INTERVAL_SECONDS = 3600.0  # a use is noted once in it, to save writes
MAGIC = b"steady-ppl kernel 1\n"  # the format of a file: this, the digest of its name and code, its code
FILE_NAME = re.compile(r"[0-9a-f]{64}(\.[0-9a-f]{16}\.partial)?")  # the names of files; others are left alone
DIGEST_BYTES = sha256().digest_size
SWEEP_PREFIX = "0"  # how names begin whose writing is followed by a look through the folder: one in sixteen
OTHERS_CAN_WRITE = stat.S_IWGRP | stat.S_IWOTH


class _NotKept(Exception):
    """Nothing can be kept; the message says why."""


def machine_code(key: str, text: Callable[[], str]) -> Any:
    """The engine of a kernel, from the disk if its code is there.

    Args:
        key: a digest of all that the text is made of. With the sources of this package, its version and those of
            numba and llvmlite it must determine the text: kernels of the same key are taken for the same.
        text: writes the code for LLVM, which must hold no address. It is called only where none is kept.
    """
    name, made = _name(key), list[bytes]()
    triple, cpu, features = _processor()
    machine = binding.Target.from_triple(triple).create_target_machine(cpu=cpu, features=features, opt=3)
    with _folder() as folder:
        kept = None if folder is None else _read(folder, name)
        module = binding.parse_assembly(text() if kept is None else "")
        if kept is None:
            passes = binding.create_pass_builder(machine, binding.create_pipeline_tuning_options(speed_level=2))
            passes.getModulePassManager().run(module, passes)
        engine = binding.create_mcjit_compiler(module, machine)
        engine.set_object_cache(lambda _, code: made.append(code), lambda _: kept)
        engine.finalize_object()
        if folder is not None and kept is None and made:
            _write(folder, name, made.pop())
            if name.startswith(SWEEP_PREFIX):
                _evict(folder)
        return engine


@lru_cache(maxsize=1)
def _processor() -> tuple[str, str, str]:
    """What code is made for: the system, the processor and what it can do."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.get_default_triple(), binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()


def _name(key: str) -> str:
    """The name of a kernel's file: code for another processor or by another version has another one."""
    return sha256("\0".join((MAGIC.decode(), key, *_versions(), *_processor())).encode()).hexdigest()


@lru_cache(maxsize=1)
def _versions() -> tuple[str, ...]:
    """What makes a text of a graph, and machine code of that."""
    try:
        ours = version("steady-ppl")
    except PackageNotFoundError:
        ours = "not installed as a package"
    sources = sha256()  # a line of theirs may change without a new version
    for file in sorted(Path(__file__).parent.glob("*.py")):
        sources.update(file.read_bytes())
    llvm = ".".join(map(str, binding.llvm_version_info))
    return ours, sources.hexdigest(), numba.__version__, llvmlite.__version__, llvm


def _digest(name: str, code: bytes) -> bytes:
    """Of a file under its own name, so that no kernel is taken for another."""
    return sha256(name.encode() + code).digest()


def _read(folder: int, name: str) -> bytes | None:
    """The code that is kept; None where there is none that is whole."""
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
        with open(file, "rb") as opened:
            about = os.fstat(file)
            if not stat.S_ISREG(about.st_mode) or about.st_uid != os.geteuid() or about.st_mode & OTHERS_CAN_WRITE:
                return None
            whole = opened.read()
            if abs(time.time() - about.st_mtime) > USE_INTERVAL_SECONDS:
                with suppress(OSError):  # a disk that cannot be written to can be read
                    os.utime(file)
    except OSError:
        return None
    start = len(MAGIC) + DIGEST_BYTES
    code = whole[start:]
    return code if whole[:start] == MAGIC + _digest(name, code) else None


def _write(folder: int, name: str, code: bytes) -> None:
    """Keep code under a name, whole or not at all; where it cannot be written, it is not kept."""
    beside = f"{name}.{secrets.token_hex(8)}.partial"
    try:
        with suppress(OSError):
            file = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600, dir_fd=folder)
            with open(file, "wb") as opened:
                opened.write(MAGIC + _digest(name, code) + code)
            os.replace(beside, name, src_dir_fd=folder, dst_dir_fd=folder)
    finally:
        with suppress(OSError):  # it is gone, unless something went wrong
            os.unlink(beside, dir_fd=folder)


def _evict(folder: int) -> None:
    """Remove the files that were used longest ago until three quarters of the bound are left: the last one is for what
    is written until the folder is next looked through."""
    found = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if FILE_NAME.fullmatch(entry.name):
                with suppress(OSError):  # another process has removed it
                    about = entry.stat(follow_symlinks=False)
                    found.append((about.st_mtime, about.st_size, entry.name))
    left = sum(size for _, size, _ in found)
    for _, size, name in sorted(found):
        if left <= MAX_BYTES * 3 // 4:
            return
        with suppress(OSError):
            os.unlink(name, dir_fd=folder)
        left -= size


@contextmanager
def _folder() -> Iterator[int | None]:
    """The folder, open; None where nothing can be kept."""
    try:
        folder = _open_folder()
    except _NotKept:
        yield None
        return
    try:
        yield folder
    finally:
        os.close(folder)


def _open_folder() -> int:
    """Open the folder, made if need be, and check what was opened: its files are then found through it alone. Those
    above it are checked too: who can write there can put another folder of the user's in its place."""
    if not hasattr(os, "geteuid") or os.open not in os.supports_dir_fd:
        raise _NotKept("this system does not say who owns a folder")
    place = _folder_path()
    try:
        above = place.parent.resolve()
        for folder in (*reversed(place.parents), *reversed(above.parents), above):
            _require_trusted(folder)
        for folder in (*reversed(above.parents), above, place := above / place.name):
            if not folder.is_dir():
                folder.mkdir(0o700, exist_ok=True)  # another process may be first
        opened = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError as error:
        raise _NotKept(f"{error.filename or place}: {error.strerror or error}") from error
    except RuntimeError as error:  # so says pathlib before Python 3.13
        raise _NotKept(f"{place}: a link leads back to itself") from error
    about = os.fstat(opened)
    if about.st_uid == os.geteuid() and not about.st_mode & OTHERS_CAN_WRITE:
        return opened
    os.close(opened)
    raise _NotKept(f"{place} is another user's, or others can write there")


def _folder_path() -> Path:
    """Where the folder is to be."""
    named = os.environ.get(ENVIRONMENT_VARIABLE, "")
    if named == "off":
        raise _NotKept(f"{ENVIRONMENT_VARIABLE} is off")
    if named:
        if not Path(named).is_absolute():
            raise _NotKept(f"{ENVIRONMENT_VARIABLE} is no absolute path")
        return Path(named)
    cache = os.environ.get("XDG_CACHE_HOME", "")
    if Path(cache).is_absolute():
        return Path(cache, "steady-ppl", "kernels")
    try:
        home = Path.home()
    except RuntimeError as error:
        raise _NotKept("the user has no home folder") from error
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "steady-ppl" / "kernels"


def _require_trusted(folder: Path) -> None:
    """Refuse a folder or link of another user's, root excepted, and a folder where others can write; but in one like
    `/tmp` they can put nothing in the place of what is the user's."""
    try:
        about = folder.lstat()
    except FileNotFoundError:
        return
    shared = stat.S_ISDIR(about.st_mode) and about.st_mode & OTHERS_CAN_WRITE and not about.st_mode & stat.S_ISVTX
    if about.st_uid not in (0, os.geteuid()) or shared:
        raise _NotKept(f"{folder} is another user's, or others can write there")
