"""Compiled code on the disk, when several processes want it at once; and the word while it is made."""

import importlib
import os
import pkgutil
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter

from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

import sb3_kfcv
from sb3_kfcv.common.kernels import NOTICE, SharedCacheFile, kernel


class Slow(SharedCacheFile):
    """Takes its time between reading the index and writing it."""

    def _load_index(self):
        found = super()._load_index()
        time.sleep(0.2)
        return found


def test_of_two_that_write_at_once_each_gets_a_file_of_its_own(tmp_path):
    def write(key):
        Slow(str(tmp_path), "function", "stamp").save(key, f"compiled for {key}")

    writers = [threading.Thread(target=write, args=(key,)) for key in ("int", "float")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    for key in ("int", "float"):
        assert SharedCacheFile(str(tmp_path), "function", "stamp").load(key) == f"compiled for {key}"


def test_who_reads_waits_until_all_is_written(tmp_path):
    """Else the index of new code could lead to the file of old code, which is overwritten after it."""
    SharedCacheFile(str(tmp_path), "function", "old").save("int", "old code")
    index_is_new = threading.Event()

    class Writer(SharedCacheFile):
        def _save_data(self, name, data):
            index_is_new.set()
            time.sleep(0.2)
            super()._save_data(name, data)

    writer = threading.Thread(target=Writer(str(tmp_path), "function", "new").save, args=("int", "new code"))
    writer.start()
    assert index_is_new.wait(10)
    assert SharedCacheFile(str(tmp_path), "function", "new").load("int") == "new code"
    writer.join()


def test_a_folder_without_locks_is_used_without(tmp_path, monkeypatch):
    SharedCacheFile(str(tmp_path), "function", "stamp").save("int", "code")

    def no_locks(self):
        raise NotImplementedError("the file system knows no locks")

    monkeypatch.setattr("sb3_kfcv.common.kernels.FileLock.acquire", no_locks)
    assert SharedCacheFile(str(tmp_path), "function", "stamp").load("int") == "code"


def compiled_functions():
    modules = [
        importlib.import_module(found.name)
        for found in pkgutil.walk_packages(sb3_kfcv.__path__, "sb3_kfcv.")
        if not found.name.endswith("__main__")
    ]
    return {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}


def test_no_two_compiled_functions_have_one_name():
    """Compiled code calls functions by their names and by numbers that differ between processes."""
    names = Counter((function.py_func.__module__, function.py_func.__qualname__) for function in compiled_functions())
    assert set(names.values()) == {1}, names.most_common(3)


def test_every_compiled_function_on_the_disk_is_shared():
    functions = compiled_functions()
    files = {function: getattr(function._cache, "_cache_file", None) for function in functions}
    kept = {function: type(file) for function, file in files.items() if file is not None}
    assert len(kept) > 40
    assert set(kept.values()) == {SharedCacheFile}, kept


def test_processes_that_begin_together_compile_the_same(tmp_path):
    """Each for three kinds of numbers, in one order or the other."""
    (tmp_path / "functions.py").write_text(
        textwrap.dedent(
            """
            import sys
            from sb3_kfcv.common.kernels import kernel

            @kernel
            def half(number):
                return number / 2

            for number in [3, 3.5, True][:: int(sys.argv[1])]:
                assert half(number) == number / 2, number
            print(type(half._cache._cache_file).__name__)
            """
        )
    )
    processes = [
        subprocess.Popen([sys.executable, "functions.py", order], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
        for order in ("1", "-1")
    ]
    for process in processes:
        printed, _ = process.communicate(timeout=100)
        assert (process.returncode, printed.strip()) == (0, "SharedCacheFile")


def test_options_reach_the_compiler():
    @kernel(nogil=True)
    def one():
        return 1

    assert one() == 1 and one.targetoptions["nogil"]


def test_numba_still_has_the_files_that_are_shared():
    """If it had not, functions would be compiled and kept as numba does it, and this says so."""
    assert {"load", "save", "_load_index", "_save_index", "_save_data"} <= set(vars(IndexDataCacheFile))


DRAW = """
import numpy as np
from sb3_kfcv.envs import physics
physics.uniform(np.zeros(1, dtype=np.uint64), 0, 0.0, 1.0)
physics.clipped(0.0, 1.0)
"""


def test_compiling_is_told_once_and_then_never_again(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for expected in (f"{NOTICE}\n", ""):
        done = subprocess.run([sys.executable, "-c", DRAW], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout == ""
        assert done.stderr == expected
