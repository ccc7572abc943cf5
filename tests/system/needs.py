"""`python -m tests.system.needs`: install what the system tests need beside the environment, or say what is missing.

Debian packages through the machine's own apt, as root; npm packages from the lock file in `peers`.
"""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

PEERS = Path(__file__).parent / "peers"
#: A command that shows whether the Debian packages are there.
PACKAGES = {
    "linux.uml": "user-mode-linux",
    "ip": "iproute2",
    "candump": "can-utils",
    "insmod": "kmod",
    "cc": "gcc libc6-dev",
    "node": "nodejs",
    "npm": "npm",
    "chromium": "chromium",
}
OLDEST_NODE = 18


def main() -> None:
    if os.geteuid() != 0:
        _fail("the system tests need root: they make network interfaces, and give processes real-time priority")
    _debian_packages()
    _node()
    _npm_packages()


def _debian_packages() -> None:
    missing = _missing()
    if not missing:
        return
    if shutil.which("apt-get") is None:
        _fail(f"missing, and there is no apt-get to install them with: {_listed(missing)}")
    names = [name for command in missing for name in PACKAGES[command].split()]
    print(f"installing {' '.join(names)}", flush=True)
    install = ["apt-get", "install", "-y", "--no-install-recommends", *names]
    said = ""
    for command in (install, ["apt-get", "update"], install):
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        )
        said = done.stderr.strip()[-1000:]
        if not (missing := _missing()):
            return
    _fail(f"could not be installed: {_listed(missing)}. apt-get says: {said}")


def _node() -> None:
    version = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True).stdout.strip()
    if int(version.removeprefix("v").partition(".")[0]) < OLDEST_NODE:
        _fail(f"node is {version}; the peers need {OLDEST_NODE} or newer")


def _npm_packages() -> None:
    """As the lock file has them; nothing is done when they are there already."""
    lock = (PEERS / "package-lock.json").read_bytes()
    done_for = PEERS / "node_modules" / ".installed"
    if done_for.is_file() and done_for.read_bytes() == lock:
        return
    begin_s = time.monotonic()
    command = ["npm", "ci", "--omit=optional", "--omit=dev"]
    print(f"{' '.join(command)} in {PEERS}", flush=True)
    done = subprocess.run(command, cwd=PEERS, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        _fail(f"npm ci has failed: {done.stderr.strip()[-1000:]}")
    done_for.write_bytes(lock)
    print(f"npm packages installed in {time.monotonic() - begin_s:.0f} s", flush=True)


def _missing() -> list[str]:
    return [command for command in PACKAGES if shutil.which(command) is None]


def _listed(commands: list[str]) -> str:
    return ", ".join(f"{command} (Debian package {PACKAGES[command]})" for command in commands)


def _fail(text: str) -> None:
    sys.exit(f"system tests cannot run: {text}")


if __name__ == "__main__":
    main()
