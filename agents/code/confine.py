"""What a computation's process cannot do any more: open a socket, start a program, write a file, take all memory.

Linux alone. A filter of system calls (seccomp) needs no rights and no namespaces, holds for any user, and cannot be
taken back. Where the kernel does not take it nothing is computed.
"""

import ctypes
import os
import platform
import resource
from dataclasses import dataclass

_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06  # BPF: ld abs, jeq, jge, ret
_ALLOW, _DENY = 0x7FFF0000, 0x00050000 | 1  # SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO | EPERM
_NUMBER_AT, _ARCHITECTURE_AT = 0, 4  # in struct seccomp_data
_NO_NEW_PRIVILEGES, _SET_FILTER, _ALL_THREADS = 38, 1, 1
_OTHER_ABI = 0x40000000  # x32, on x86-64: other numbers for the same calls


@dataclass(frozen=True)
class _Numbers:
    """Of system calls on one processor architecture."""

    architecture: int  #: AUDIT_ARCH_*
    seccomp: int
    denied: tuple[int, ...]  #: socket, execve, execveat, ptrace, io_uring_setup


_KNOWN = {
    "x86_64": _Numbers(0xC000003E, 317, (41, 59, 322, 101, 425)),
    "aarch64": _Numbers(0xC00000B7, 277, (198, 221, 281, 117, 425)),
}


class NotConfined(Exception):
    """This computer cannot keep a computation to itself; the text says why."""


class _Instruction(ctypes.Structure):
    _fields_ = [("code", ctypes.c_uint16), ("jt", ctypes.c_uint8), ("jf", ctypes.c_uint8), ("k", ctypes.c_uint32)]


class _Program(ctypes.Structure):
    _fields_ = [("length", ctypes.c_uint16), ("filter", ctypes.POINTER(_Instruction))]


def forbid_sockets_and_programs() -> None:
    """For this process and all that it starts, for good. Raises NotConfined."""
    numbers = _KNOWN.get(platform.machine())
    if numbers is None:
        raise NotConfined(f"system calls of {platform.machine()} are not known here; allowed: {', '.join(_KNOWN)}")
    steps = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT), (_EQUAL, 1, 0, numbers.architecture), (_RETURN, 0, 0, _DENY),
        (_LOAD, 0, 0, _NUMBER_AT), (_AT_LEAST, 0, 1, _OTHER_ABI), (_RETURN, 0, 0, _DENY),
    ]  # fmt: skip
    for number in numbers.denied:
        steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _DENY)]
    steps.append((_RETURN, 0, 0, _ALLOW))
    program = _Program(len(steps), (_Instruction * len(steps))(*(_Instruction(*step) for step in steps)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(
        numbers.seccomp, _SET_FILTER, _ALL_THREADS, ctypes.byref(program)
    ):
        raise NotConfined(f"the kernel takes no filter of system calls: {os.strerror(ctypes.get_errno())}")


def bound_memory(most_bytes: int) -> None:
    """Beyond it there is none."""
    resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))


def forbid_writing() -> None:
    """No file takes a byte more, and no core is dumped."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def bound_processor_time(most_s: int) -> None:
    """From now on; beyond it the kernel ends the process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    until_s = int(used.ru_utime + used.ru_stime) + 1 + most_s
    resource.setrlimit(resource.RLIMIT_CPU, (until_s, until_s + 1))
