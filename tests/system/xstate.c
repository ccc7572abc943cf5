/* user-mode-linux 6.1 knows 2,696 bytes of a processor's extended state. Where the processor has more (AMX), the host's
 * kernel refuses to set a part, and the guest panics at its first process. Loaded before libc, this sets the whole: what
 * the guest gives, and behind it what the host has. No guest uses AMX.
 *
 * The kernel runs on stacks of a few pages and in one thread, so the buffer is static. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

typedef long (*ptrace_t)(int, pid_t, void *, void *);

long ptrace(enum __ptrace_request request, ...)
{
    static ptrace_t libc_ptrace;
    static char whole[1 << 16];

    va_list arguments;
    va_start(arguments, request);
    pid_t process = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);

    if (!libc_ptrace)
        libc_ptrace = (ptrace_t)dlsym(RTLD_NEXT, "ptrace");
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
        struct iovec *given = data;
        struct iovec all = {whole, sizeof whole};
        if (libc_ptrace(PTRACE_GETREGSET, process, address, &all) == 0 && given->iov_len < all.iov_len) {
            memcpy(whole, given->iov_base, given->iov_len);
            return libc_ptrace(request, process, address, &all);
        }
    }
    return libc_ptrace(request, process, address, data);
}
