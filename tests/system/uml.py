"""A command in a Linux kernel of its own (user-mode-linux), for what the host's kernel cannot do.

The guest runs on the host's own files, read-only, but for one folder that both share: command, output and exit code
go through files in it. No image is built, and nothing depends on a console.
"""

import os
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

KERNEL = "linux.uml"
INIT = Path(__file__).parent / "guest_init.sh"
XSTATE = Path(__file__).parent / "xstate.c"
MEMORY_MB = 1536
LINKS = "r2rgate-guest"  #: begins the name of a guest's folder of links, before the number of this process
#: A host that is busy must not look like a line that stalls. Below the loops of other lines on this host.
PUNCTUAL = ("chrt", "--fifo", "10")


class GuestFailed(Exception):
    """The guest did not come to the end of its command; the text holds what it said last."""


@dataclass(frozen=True, slots=True)
class Outcome:
    code: int  #: exit code of the command
    output: str  #: standard output and error


def run_in_guest(
    command: Sequence[str | Path], share: Path, limit_s: float, environment: Mapping[str, str] | None = None
) -> Outcome:
    """Run `command` in the current folder, as root, with the folder `share` writable under its own path.

    Raises GuestFailed when the guest ends without a result or takes longer than `limit_s`. No process is left.
    """
    share = share.resolve()
    share.mkdir(parents=True, exist_ok=True)
    for name in ("code", "output"):
        (share / name).unlink(missing_ok=True)
    words = " ".join(shlex.quote(str(word)) for word in command)
    given = "".join(f"export {key}={shlex.quote(value)}\n" for key, value in (environment or {}).items())
    (share / "command").write_text(f"{given}exec {words}\n")
    kernel = shutil.which(KERNEL)
    if kernel is None:
        raise GuestFailed(f"{KERNEL} is missing: install the Debian package user-mode-linux")
    with tempfile.TemporaryDirectory(prefix=f"{LINKS}-{os.getpid()}-") as links:
        folder = Path(links)
        (folder / "share").symlink_to(share)
        (folder / "here").symlink_to(Path.cwd())
        shutil.copy(INIT, folder / "init")
        xstate = _compiled(XSTATE, folder / "xstate.so")
        arguments = [
            f"mem={MEMORY_MB}M", "rootfstype=hostfs", "rootflags=/", "ro", f"init={folder / 'init'}", f"links={folder}",
            "quiet", "con=null", "con0=null,fd:1", "ssl=null", f"uml_dir={folder}/",
        ]  # fmt: skip
        _boot([*PUNCTUAL, kernel, *arguments], share, limit_s, xstate)
    if not (share / "code").is_file():
        raise GuestFailed(f"the guest ended without a result\n{_last_words(share)}")
    return Outcome(int((share / "code").read_text()), (share / "output").read_text(errors="replace"))


def _compiled(source: Path, library: Path) -> Path:
    """Raises GuestFailed."""
    done = subprocess.run(
        ["cc", "-O2", "-shared", "-fPIC", "-o", library, source], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise GuestFailed(f"{source.name} does not compile: {done.stderr}")
    return library


def _boot(command: list[str], share: Path, limit_s: float, preloaded: Path) -> None:
    """Until the guest halts. Raises GuestFailed."""
    with (share / "console").open("wb") as sink:
        guest = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT, start_new_session=True,
            env=os.environ | {"LD_PRELOAD": str(preloaded)},
        )  # fmt: skip
        try:
            guest.wait(limit_s)
        except subprocess.TimeoutExpired:
            raise GuestFailed(f"the guest took longer than {limit_s:g} s\n{_last_words(share)}") from None
        finally:
            _end(guest)


def _end(guest: subprocess.Popen[bytes]) -> None:
    """Every process of the guest is of the session, and the process group, that this one leads."""
    try:
        os.killpg(guest.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    guest.wait()


def _last_words(share: Path) -> str:
    words = ""
    for name in ("output", "console"):
        path = share / name
        text = path.read_text(errors="replace").splitlines()[-20:] if path.is_file() else ["(nothing)"]
        words += f"--- end of {name}\n" + "\n".join(text) + "\n"
    return words
