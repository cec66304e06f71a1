"""Generate a small C program from api.h that loads the kernels of another system and calls their functions.

It shares a file with the caller, mapped at the same address, so that pointers are valid on both sides. A call is the
number of the function on its standard input. The arguments are at the beginning of the file, eight bytes each, and are
replaced by the result.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from cross_compile import KERNELS, TARGETS

from rigkit.kernels.declarations import Declaration, Header

ADDRESS = 0x2000_0000_0000
"""Where the file lies: far from what processes of these systems map by themselves."""
MEGABYTES = 1024
"""Of address space; what is not used takes none."""

POSIX = """
#include <dlfcn.h>
#include <fcntl.h>
#include <sys/mman.h>
static void *library(const char *path) { return dlopen(path, RTLD_NOW); }
static void *function(void *of, const char *name) { return dlsym(of, name); }
static void *shared(const char *path)
{
    int file = open(path, O_RDWR);
    return mmap((void *)AT, WHOLE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_FIXED, file, 0);
}
"""
WINDOWS = """
#include <fcntl.h>
#include <io.h>
#include <windows.h>
static void *library(const char *path) { return LoadLibraryA(path); }
static void *function(void *of, const char *name) { return (void *)GetProcAddress(of, name); }
static void *shared(const char *path)
{
    _setmode(_fileno(stdin), _O_BINARY);
    _setmode(_fileno(stdout), _O_BINARY);
    const DWORD both = GENERIC_READ | GENERIC_WRITE, others = FILE_SHARE_READ | FILE_SHARE_WRITE;
    HANDLE file = CreateFileA(path, both, others, NULL, OPEN_EXISTING, 0, NULL);
    HANDLE mapping = CreateFileMappingA(file, NULL, PAGE_READWRITE, 0, 0, NULL);
    return MapViewOfFileEx(mapping, FILE_MAP_WRITE, 0, 0, WHOLE, (void *)AT);
}
"""
MAIN = """
int main(int count, char **words)
{
    char *slots = shared(words[2]);
    void *kernels = library(words[1]);
    if (count != 3 || slots != (char *)AT || kernels == NULL) {
        fprintf(stderr, "%s does not load, or the file is not mapped\\n", words[1]);
        return 1;
    }
    for (int64_t which; fread(&which, sizeof which, 1, stdin) == 1;) {
        call(kernels, which, slots);
        fwrite(&which, sizeof which, 1, stdout);
        fflush(stdout);
    }
    return 0;
}
"""


def host_source(header: Header, platform: str) -> str:
    """Return the program for a system, "win32" or another."""
    system = WINDOWS if platform == "win32" else POSIX
    cases = "\n".join(_case(which, name, header) for which, name in enumerate(header.functions))
    return f"""#define _GNU_SOURCE
#include <stdio.h>
#include "api.h"
#define AT {ADDRESS:#x}LL
#define WHOLE ((size_t){MEGABYTES} << 20)
{system}
static void call(void *kernels, int64_t which, char *slots)
{{
    switch (which) {{
{cases}
    }}
}}
{MAIN}"""


def _case(which: int, name: str, header: Header) -> str:
    """Return the call of one function, with each argument out of its slot and the result into the first."""
    parameters, result = header.functions[name], header.results[name]
    kinds = [_kind(one) for one in parameters]
    # What is passed by value, other than a number, is passed on from where it lies.
    values = [
        f"**({kind} **)(slots + {8 * i})"
        if one.type in header.structures and not one.pointer
        else f"*({kind} *)(slots + {8 * i})"
        for i, (one, kind) in enumerate(zip(parameters, kinds, strict=True))
    ]
    kind = _kind(result)
    called = f'(({kind} (*)({", ".join(kinds) or "void"}))function(kernels, "{name}"))({", ".join(values)})'
    if kind == "void":
        return f"    case {which}: {called}; break;"
    if kind == "char *":
        return f'    case {which}: snprintf(slots, 256, "%s", {called}); break;'
    return f"    case {which}: *({kind} *)slots = {called}; break;"


def _kind(one: Declaration) -> str:
    """Return the C type of a parameter or result."""
    return "void *" if one.array is not None else f"{one.type} *" if one.pointer else one.type


def compile_host(header: Header, target: str, folder: Path) -> Path:
    """Compile the program for one of cross_compile's TARGETS; return it. Raises CalledProcessError."""
    triple, platform = TARGETS[target]
    source, program = folder / "host.c", folder / ("host.exe" if platform == "win32" else "host")
    source.write_text(host_source(header, platform), encoding="utf-8")
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", triple, "-O1", "-fno-sanitize=undefined"]
    zig += ["-I", str(KERNELS), str(source), *([] if platform == "win32" else ["-ldl"])]
    subprocess.run([*zig, "-o", str(program)], check=True)
    return program
