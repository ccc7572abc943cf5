"""Whether the computer is fit for a loop: processors, their frequency, swap, room on the disk, heat."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from gateway.cli.doctor_check import Check
from gateway.core.line import Line

ROOT = Path("/")
LEAST_FREE_GB = 1.0  #: less, and the history stops within hours
_GROUP = "machine"
_GB = 1e9


def machine(line: Line, gateway_data: Path, root: Path = ROOT) -> Iterator[Check]:
    """`root` is where /sys and /proc are found."""
    yield _cores(line)
    yield _governor(root)
    yield _swap(root)
    yield _throttling(root)
    yield _disk(line, gateway_data)


def _cores(line: Line) -> Check:
    usable = sorted(os.sched_getaffinity(0))
    measured = f"{len(usable)} usable"
    wanted_cpu = line.control.cpu
    if wanted_cpu is not None and wanted_cpu not in usable:
        allowed = f"control.cpu = {wanted_cpu} among them"
        todo = f"set control.cpu to one of {', '.join(map(str, usable))}, or leave it out"
        return Check(_GROUP, "processors", "", "FAIL", f"{measured}: {usable}", allowed, todo)
    if len(usable) < 2:
        todo = "the loop and everything else share one: expect jitter"
        return Check(_GROUP, "processors", "", "warning", measured, "2 or more", todo)
    return Check(_GROUP, "processors", "", "OK", measured, "2 or more")


def _governor(root: Path) -> Check:
    files = sorted(root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    found = sorted({file.read_text().strip() for file in files})
    if not found:
        return Check(_GROUP, "frequency", "governor", "skipped", "this computer does not say how its frequency is set")
    if found == ["performance"]:
        return Check(_GROUP, "frequency", "governor", "OK", "performance", "performance")
    todo = "`cpupower frequency-set -g performance`: a processor that has to speed up first is late"
    return Check(_GROUP, "frequency", "governor", "warning", ", ".join(found), "performance", todo)


def _swap(root: Path) -> Check:
    try:
        rows = (root / "proc/swaps").read_text().splitlines()[1:]
    except OSError as error:
        return Check(_GROUP, "swap", "", "skipped", f"/proc/swaps: {error.strerror}")
    used_kb = sum(int(row.split()[3]) for row in rows)
    if not rows:
        return Check(_GROUP, "swap", "", "OK", "none", "none, or unused")
    if used_kb == 0:
        return Check(_GROUP, "swap", "", "OK", f"{len(rows)}, unused", "none, or unused")
    todo = "the loop locks its memory, the gateway does not: `swapoff -a`, or add memory"
    return Check(_GROUP, "swap", "", "warning", f"{used_kb / 1e3:.0f} MB in use", "none, or unused", todo)


def _throttling(root: Path) -> Check:
    """Counts of Intel processors, and the flags of a Raspberry Pi (bits 16 to 19: has happened since it was on)."""
    intel = list(root.glob("sys/devices/system/cpu/cpu[0-9]*/thermal_throttle/*_throttle_count"))
    pi = root / "sys/devices/platform/soc/soc:firmware/get_throttled"
    todo = "look at fan, dust, supply and the cabinet's temperature: a slowed processor is late"
    if intel:
        count = max(int(file.read_text()) for file in intel)
        verdict = "warning" if count else "OK"
        return Check(
            _GROUP, "throttling", "", verdict, f"{count} times since it was on", "never", todo if count else ""
        )
    if pi.exists():
        flags = int(pi.read_text().strip(), 16)
        return Check(
            _GROUP, "throttling", "", "warning" if flags else "OK", f"flags {flags:#x}", "0", todo if flags else ""
        )
    return Check(_GROUP, "throttling", "", "skipped", "this computer does not count it")


def _disk(line: Line, gateway_data: Path) -> Check:
    there = existing(gateway_data)
    free_gb = shutil.disk_usage(there).free / _GB
    kept_gb = sum(file.stat().st_size for file in gateway_data.glob("*") if file.is_file()) / _GB
    needed_gb = max(0.0, line.history.keep_gb - kept_gb)
    measured, wanted = f"{free_gb:.1f} GB free at {there}", f"{needed_gb:.1f} GB more will be kept (history.keep_gb)"
    if free_gb < LEAST_FREE_GB:
        return Check(_GROUP, "disk", "", "FAIL", measured, wanted, "make room: without it nothing is recorded")
    if free_gb < needed_gb:
        return Check(_GROUP, "disk", "", "warning", measured, wanted, "make room, or lower history.keep_gb")
    return Check(_GROUP, "disk", "", "OK", measured, wanted)


def existing(folder: Path) -> Path:
    """`folder`, or the nearest above it that exists."""
    return next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
