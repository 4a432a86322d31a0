"""What the results were measured with: versions, source, machine. No names of users, hosts or folders."""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# The packages whose code decides what is measured; reports only show it, as do the files that read rows.
MEASURING_PACKAGES = ("solvers", "scenarios", "harness")
READING_FILES = ("harness/claims.py", "harness/results.py")
LIBRARIES = ("numpy", "scipy", "numba")


def package_version() -> str:
    """Version of impactbench: of the source folder that it runs from, else of the installed package."""
    try:
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8")).get("project", {})
    except OSError:
        project = {}
    if project.get("name") == "impactbench":
        return str(project["version"])
    return metadata.version("impactbench")


def library_versions() -> dict[str, str]:
    """Versions of the libraries whose arithmetic the results depend on."""
    return {name: metadata.version(name) for name in LIBRARIES}


def source_digest() -> str:
    """SHA-256 over the code that measures, first 16 digits: results of two codes are never mixed."""
    digest = hashlib.sha256()
    for package in MEASURING_PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name not in READING_FILES:
                digest.update(name.encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def describe_environment() -> dict[str, object]:
    """All that a reader needs to judge a time or to repeat a number; JSON-able."""
    return {
        "impactbench": package_version(),
        "source": source_digest(),
        "commit": _git_commit(),
        "python": platform.python_version(),
        **library_versions(),
        "cpu": _cpu_model(),
        "cores": available_cores(),
        "machine": platform.machine(),
        "os": f"{platform.system()} {platform.release()}",
    }


def available_cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def ensure_kernel_cache() -> None:
    """Give numba a folder for compiled kernels where it would find none; call before `solvers` is imported.

    numba keeps them beside the source, else in the user's cache folder, and refuses to import a cached kernel where
    neither can be written (a read-only installation in a container). Then they live in a private folder until this
    process ends. A folder of a fixed name would not be safe: its files are unpickled, and others could write them.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "numba"
    if any(_is_writable(folder) for folder in (ROOT / "solvers" / "__pycache__", user_cache)):
        return
    folder = tempfile.mkdtemp(prefix="impactbench-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder


def _is_writable(folder: Path) -> bool:
    """Try it as numba does: make the folder and a file in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _git_commit() -> str | None:
    """Commit of the source folder, with "+changes" where it was edited since; None outside a checkout."""
    if not (ROOT / ".git").exists():
        return None
    try:
        commit = _git("rev-parse", "HEAD")
        changes = _git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}+changes" if changes else commit


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=10,
        stdin=subprocess.DEVNULL,
    )
    return done.stdout.strip()


def _cpu_model() -> str:
    """Name of the processor, as the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
