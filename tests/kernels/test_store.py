"""Machine code on disk: the same numbers as compiled anew, from the user's own folder, and never a fault."""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from steady_ppl.kernels import store

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="nothing is kept on this system")

KERNEL = """
import ctypes
import numpy as np
from steady_ppl.kernels import store

def text():
    from steady_ppl.kernels.codegen import source
    from steady_ppl.kernels.graph import PARTICLE, ScalarGraph
    print("written")
    graph = ScalarGraph({"x": PARTICLE})
    x = graph.scalar("input", "x", 0)
    graph.outputs = [graph.scalar("sin", x), graph.scalar("exp", x)]
    return source(graph, ("x",), {})

engine = store.machine_code("sine and exponential", text)
call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5, *[ctypes.c_int64] * 3)(engine.get_function_address("kernel"))
x, out, none = np.linspace(-3, 3, 40, dtype=np.float32), np.zeros((2, 40), np.float32), np.zeros(1, np.float32)
call(none.ctypes.data, none.ctypes.data, x.ctypes.data, None, out.ctypes.data, 1, 40, 0)
np.testing.assert_allclose(out, [np.sin(x), np.exp(x)], rtol=1e-5, atol=1e-6)
print(out.tobytes().hex())
"""
MANY = """
import ctypes
from steady_ppl.kernels import store
for number in range(30):
    text = f"define i32 @kernel() {{ ret i32 {number} }}"
    engine = store.machine_code(str(number), lambda: text)
    assert ctypes.CFUNCTYPE(ctypes.c_int)(engine.get_function_address("kernel"))() == number
with store._folder() as folder:
    assert folder is not None
"""
NO_ROOM = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
"""


def start(script: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def said(script: str) -> list[str]:
    """What a process prints, a line each."""
    process = start(script)
    out, error = process.communicate()
    assert process.returncode == 0 and not error, error
    return out.splitlines()


def not_kept() -> str | None:
    """Why no machine code is kept; None where it is."""
    try:
        os.close(store._open_folder())
    except store._NotKept as reason:
        return str(reason)
    return None


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where code is kept; it is made by the first use."""
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def compiled(key: str = "a", number: int = 42) -> bool:
    """Whether a kernel that returns a number had to be compiled."""
    texts = []

    def text() -> str:
        texts.append(f"define i32 @kernel() {{ ret i32 {number} }}")
        return texts[0]

    engine = store.machine_code(key, text)
    assert ctypes.CFUNCTYPE(ctypes.c_int)(engine.get_function_address("kernel"))() == number
    return bool(texts)


def age(file: Path, seconds: float) -> float:
    then = time.time() - seconds
    os.utime(file, (then, then))
    return file.stat().st_mtime


# what is kept


@pytest.mark.slow
def test_another_process_finds_the_code_and_comes_to_the_same_bits(folder):
    first, second = said(KERNEL), said(KERNEL)
    assert first[0] == "written" and second == first[1:]
    (file,) = folder.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700 and file.stat().st_mode & 0o777 == 0o600


def test_each_key_has_its_own_code(folder):
    assert compiled("a", 1) and compiled("b", 2)
    assert not compiled("a", 1) and not compiled("b", 2)
    assert len(list(folder.iterdir())) == 2


def test_other_versions_and_processors_have_code_of_their_own(folder, monkeypatch):
    names = {store._name("a"), store._name("b")}
    for part, now in (("_versions", store._versions()), ("_processor", store._processor())):
        for k in range(len(now)):
            with monkeypatch.context() as patch:
                patch.setattr(store, part, lambda now=now, k=k: (*now[:k], "another", *now[k + 1 :]))
                names.add(store._name("a"))
    monkeypatch.setattr(store, "MAGIC", b"another format\n")
    assert len({*names, store._name("a")}) == 2 + 5 + 3 + 1


def test_a_text_that_cannot_be_written_leaves_nothing(folder):
    def text() -> str:
        raise ValueError("no kernel for this")

    with pytest.raises(ValueError, match="no kernel for this"):
        store.machine_code("a", text)
    assert not list(folder.iterdir())
    assert compiled("a") and not compiled("a")


@pytest.mark.slow
def test_several_processes_at_once(folder):
    processes = [start(MANY) for _ in range(4)]
    for process in processes:
        out, error = process.communicate()
        assert process.returncode == 0 and not out and not error, error
    assert len(list(folder.iterdir())) == 30
    assert not any(compiled(str(number), number) for number in range(30))


# what is not taken


def cut(file: Path, other: bytes) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def cut_header(file: Path, other: bytes) -> None:
    file.write_bytes(file.read_bytes()[:30])


def empty(file: Path, other: bytes) -> None:
    file.write_bytes(b"")


def longer(file: Path, other: bytes) -> None:
    file.write_bytes(file.read_bytes() + b"\0")


def a_bit(file: Path, other: bytes) -> None:
    whole = bytearray(file.read_bytes())
    whole[-100] ^= 1
    file.write_bytes(whole)


def of_another_kernel(file: Path, other: bytes) -> None:
    file.write_bytes(other)


def without_header(file: Path, other: bytes) -> None:
    file.write_bytes(file.read_bytes()[len(store.MAGIC) + store.DIGEST_BYTES :])


def of_another_format(file: Path, other: bytes) -> None:
    file.write_bytes(file.read_bytes().replace(b"kernel 1", b"kernel 2", 1))


def open_to_others(file: Path, other: bytes) -> None:
    file.chmod(0o622)


def a_link(file: Path, other: bytes) -> None:
    file.rename(file.parent.parent / "elsewhere")
    file.symlink_to(file.parent.parent / "elsewhere")


def a_pipe(file: Path, other: bytes) -> None:
    file.unlink()
    os.mkfifo(file)


SPOILT = (
    cut, cut_header, empty, longer, a_bit, of_another_kernel, without_header, of_another_format, open_to_others, a_link,
    a_pipe,
)  # fmt: skip


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_file_that_is_not_as_it_was_written_is_replaced(folder, spoil):
    assert compiled("a", 1) and compiled("b", 2)
    file, other = folder / store._name("a"), folder / store._name("b")
    spoil(file, other.read_bytes())
    assert compiled("a", 1) and not compiled("a", 1)
    assert file.is_file() and not file.is_symlink() and file.stat().st_mode & 0o777 == 0o600


def test_a_pipe_is_replaced_whatever_it_holds(folder):
    assert compiled()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.unlink()
    os.mkfifo(file, 0o600)
    both_ends = os.open(file, os.O_RDWR | os.O_NONBLOCK)
    try:
        os.write(both_ends, whole)
        assert compiled() and not compiled() and file.is_file()
    finally:
        os.close(both_ends)


def test_a_folder_in_the_place_of_a_file_is_left_alone(folder):
    (folder / store._name("a")).mkdir(parents=True, mode=0o700)
    folder.chmod(0o700)
    assert compiled() and compiled()
    assert [file.name for file in folder.iterdir()] == [store._name("a")]


@pytest.mark.parametrize("mode", [0o770, 0o720, 0o702, 0o777, 0o1777])
def test_a_folder_where_others_can_write_is_not_used(folder, mode):
    assert compiled() and not compiled()
    folder.chmod(mode)
    assert "others can write" in not_kept()
    assert compiled() and compiled("b")
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(("mode", "trusted"), [(0o755, True), (0o1777, True), (0o777, False), (0o770, False)])
def test_nor_one_whose_place_others_can_give_to_another(folder, monkeypatch, mode, trusted):
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "among" / "others"))
    (folder / "among").mkdir(parents=True)
    folder.chmod(mode)
    assert (not_kept() is None) is trusted
    assert compiled() and compiled() is not trusted
    assert (folder / "among" / "others").exists() is trusted


def test_a_link_is_not_used(folder):
    elsewhere = folder.with_name("elsewhere")
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)
    assert not_kept() and compiled() and compiled()
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize(("mode", "trusted"), [(0o700, True), (0o777, False)])
def test_a_cache_folder_that_is_a_link_is_judged_by_where_it_leads(folder, monkeypatch, mode, trusted):
    elsewhere = folder.with_name("elsewhere")
    elsewhere.mkdir()
    elsewhere.chmod(mode)
    folder.symlink_to(elsewhere)
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "steady-ppl" / "kernels"))
    assert (not_kept() is None) is trusted
    assert compiled() and compiled() is not trusted
    assert (elsewhere / "steady-ppl").exists() is trusted


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.parametrize("above", [False, True])
def test_a_folder_of_another_user_is_not_used(folder, monkeypatch, above):
    assert compiled() and not compiled()
    os.chown(folder, 12345, -1)
    if above:
        monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "mine"))
        (folder / "mine").mkdir(mode=0o700)
    assert "another user" in not_kept()
    assert compiled() and compiled()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives links away")
def test_nor_one_that_another_users_link_leads_to(folder, monkeypatch):
    (folder.with_name("elsewhere") / "kernels").mkdir(parents=True, mode=0o700)
    folder.symlink_to(folder.with_name("elsewhere"))
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "kernels"))
    assert compiled() and not compiled()
    os.lchown(folder, 12345, -1)
    assert "another user" in not_kept()
    assert compiled() and compiled()


# where nothing can be written


def test_a_folder_that_cannot_be_written_is_read(folder, monkeypatch):
    assert compiled("a")
    (file,) = folder.iterdir()
    age(file, 7200)
    folder.chmod(0o500)
    if os.geteuid() == 0:  # whom no mode stops
        opened = os.open

        def read_only(path, flags, *rest, **named):
            if flags & os.O_CREAT:
                raise OSError(errno.EROFS, os.strerror(errno.EROFS))
            return opened(path, flags, *rest, **named)

        def utime(*_):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

        monkeypatch.setattr(os, "open", read_only)
        monkeypatch.setattr(os, "supports_dir_fd", {*os.supports_dir_fd, read_only})
        monkeypatch.setattr(os, "utime", utime)
    assert not_kept() is None
    assert not compiled("a")
    assert compiled("b") and compiled("b")
    assert list(folder.iterdir()) == [file]


def test_a_full_disk_leaves_nothing_behind(folder):
    assert said(NO_ROOM + MANY) == []
    assert folder.is_dir() and not list(folder.iterdir())


def test_no_folder_can_be_made(folder, monkeypatch):
    folder.write_text("a file")
    assert not_kept() and compiled() and compiled()
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "below"))
    assert str(folder) in not_kept() and compiled() and compiled()
    assert folder.read_text() == "a file"


def test_links_that_lead_nowhere(folder, monkeypatch):
    folder.symlink_to(folder)
    monkeypatch.setenv("STEADY_KERNEL_CACHE", str(folder / "below"))
    assert not_kept() and compiled() and compiled()


# the bound


def test_the_bound_holds_and_what_was_used_last_stays(folder, monkeypatch):
    assert compiled("first", 0)
    (file,) = folder.iterdir()
    size = file.stat().st_size
    monkeypatch.setattr(store, "MAX_BYTES", 8 * size)
    monkeypatch.setattr(store, "SWEEP_PREFIX", "")
    (folder / "letter.txt").write_bytes(bytes(100 * size))  # nothing of ours
    left_over = folder / f"{store._name('cut off')}.{'0' * 16}.partial"
    left_over.write_bytes(bytes(size))
    age(left_over, 10000)
    for number in range(20):
        age(file, 0)  # as a use would, of another day
        assert compiled(str(number), number)
        age(folder / store._name(str(number)), 1000 - number)
        ours = [other for other in folder.iterdir() if other.name != "letter.txt"]
        assert sum(other.stat().st_size for other in ours) <= 8 * size
    assert not left_over.exists() and (folder / "letter.txt").exists()
    assert not compiled("first", 0) and not compiled("19", 19) and compiled("0", 0)
    assert len(ours) == 6


def test_one_kernel_in_sixteen_looks_through_the_folder(folder, monkeypatch):
    looked = []
    monkeypatch.setattr(store, "_evict", looked.append)
    names = [store._name(str(number)) for number in range(48)]
    assert all(compiled(str(number), number) for number in range(48))
    assert len(looked) == sum(name.startswith("0") for name in names)


def test_a_use_is_noted_once_an_hour_and_looks_at_one_file(folder, monkeypatch):
    assert compiled()
    (file,) = folder.iterdir()
    monkeypatch.setattr(os, "scandir", None)
    monkeypatch.setattr(os, "listdir", None)
    monkeypatch.setattr(os, "mkdir", None)
    before = age(file, 600)
    assert not compiled() and file.stat().st_mtime == before
    for seconds in (7200, -7200):  # a clock may have been wrong
        age(file, seconds)
        assert not compiled() and abs(file.stat().st_mtime - time.time()) < 60


# where


def test_the_users_cache_folder(folder, monkeypatch, tmp_path):
    monkeypatch.delenv("STEADY_KERNEL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert compiled() and not compiled()
    assert (tmp_path / "cache" / "steady-ppl" / "kernels" / store._name("a")).is_file()
    assert all((tmp_path / "cache" / at).stat().st_mode & 0o777 == 0o700 for at in (".", "steady-ppl"))
    monkeypatch.setattr(sys, "platform", "linux")
    for useless in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", useless)
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        assert store._folder_path() == tmp_path / "home" / ".cache" / "steady-ppl" / "kernels"


def test_off_and_paths_that_depend_on_where_one_works(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for value, why in (("off", "STEADY_KERNEL_CACHE is off"), ("kernels", "absolute")):
        monkeypatch.setenv("STEADY_KERNEL_CACHE", value)
        assert why in not_kept()
        assert compiled() and compiled()
    assert not list(tmp_path.iterdir())
