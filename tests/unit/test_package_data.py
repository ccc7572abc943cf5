"""Whatever the program reads beside its modules is in the package that is installed."""

import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_file_beside_the_modules_is_package_data():
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = [name.removesuffix("*") for name in given["packages"]["find"]["include"]]
    listed = subprocess.run(["git", "ls-files", *packages], cwd=ROOT, capture_output=True, text=True, check=True)
    read = {ROOT / name for name in listed.stdout.splitlines() if not name.endswith((".py", "README.md"))}
    packed = {
        path
        for package, patterns in given["package-data"].items()
        for pattern in patterns
        for path in (ROOT / package).glob(pattern)
    }
    assert read and sorted(read - packed) == []
