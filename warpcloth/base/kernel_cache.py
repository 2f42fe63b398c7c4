"""Repairs Warp's cache of compiled kernels, and shares its parsed C++ headers between processes.

A cache that cannot be written raises an error.
"""

import errno
import hashlib
import os
import shutil
import tempfile
from functools import cache, wraps

_ROOM = 2**23  # bytes that the source and binary of a module and the parsed headers need
_INSTANTIATE = "-fpch-instantiate-templates"
HEADERS = "wp_headers"  # first part of the name of their folder in the cache


def mend():
    """Makes Warp repair its cache when it loads a module.

    A killed process or a full disk may leave truncated files, which Warp then fails to load every time. Here the files of the
    module are removed, and it is compiled again. LLVM ends the process if the disk has no room for a binary, so that is
    checked before.
    """
    import warp as wp

    if not hasattr(wp.Module.load, "__wrapped__"):
        wp.Module.load = _mended(wp.Module.load)


def parse_headers_once():
    """Makes Warp keep its parsed headers in the kernel cache, for kernels on the CPU.

    Every kernel includes Warp's headers, which take the compiler 2.6 s to parse. Warp parses them once in each thread of each
    process; here all processes share one precompiled header. It also instantiates the templates that the headers use, which
    the compiler would otherwise repeat for each kernel. The generated code is the same. `wp.clear_kernel_cache` removes the
    folder.
    """
    import warp as wp

    flags = wp.config.cpu_compiler_flags
    if flags is not None and _INSTANTIATE not in flags:
        wp.config.cpu_compiler_flags = f"{flags} {_INSTANTIATE}"
    runtime = wp._src.context.Runtime
    if hasattr(runtime, "get_clang_pch_dir") and not hasattr(runtime.get_clang_pch_dir, "__wrapped__"):
        runtime.get_clang_pch_dir = _kept(runtime.get_clang_pch_dir)


def _kept(folder_of_thread):
    @wraps(folder_of_thread)
    def kept(runtime):
        if runtime.llvm is None:
            return folder_of_thread(runtime)
        os.makedirs(headers_folder(), exist_ok=True)
        return headers_folder()

    return kept


@cache
def headers_folder():
    """Returns the folder of parsed headers, in the kernel cache that is set when this is first called."""
    import warp as wp

    return os.path.join(wp.config.kernel_cache_dir, f"{HEADERS}_{_compiler_digest()}")


def _compiler_digest():
    """Hashes the headers, the compiler and the processor, for the compiler refuses headers that were parsed for others."""
    import warp as wp

    processor = wp._src.context.runtime.llvm.wp_get_host_cpu_name()
    digest = hashlib.sha256(wp.get_cpu_kernel_cache_key(cpu_compiler_flags="-march=native").encode() + processor)
    for folder in ("native", "bin"):
        with os.scandir(os.path.join(os.path.dirname(wp.__file__), folder)) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                status = entry.stat()
                digest.update(f"{entry.path} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:8]


def _mended(load):
    @wraps(load)
    def mended(module, device, block_dim=None, *arguments, **options):
        import warp as wp

        device = wp.get_device(device)
        key = (device.context, block_dim or module.options["block_dim"])
        if key in module.execs:
            return load(module, device, block_dim, *arguments, **options)
        folder = os.path.join(wp.config.kernel_cache_dir, module.get_module_identifier(key[1]))
        if not os.path.isdir(folder):
            refuse_full(os.path.dirname(folder))
            return load(module, device, block_dim, *arguments, **options)
        try:
            loaded = load(module, device, block_dim, *arguments, **options)
            # The linker of the CPU may accept a binary that lacks a kernel; CUDA raises an error.
            if device.is_cpu and any(loaded.get_kernel_hooks(kernel).forward is None for kernel in list(loaded.kernel_names)):
                raise RuntimeError(f"{folder}: a kernel is missing")
            return loaded
        except Exception:  # of many types; if the files are not the cause, the second load raises it again
            refuse_full(os.path.dirname(folder))
            shutil.rmtree(folder, ignore_errors=True)
            module.execs.pop(key, None)
            module.mark_modified()
        return load(module, device, block_dim, *arguments, **options)

    return mended


def refuse_full(cache):
    """Checks that a folder has room for a binary.

    Raises:
        OSError: The disk is full, or the folder cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=cache) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise described(error, cache) from None


def described(error, cache):
    """Returns an OSError like ``error`` whose message says that the folder is the kernel cache."""
    where = f"{cache}, where Warp keeps compiled kernels (WARP_CACHE_PATH names another folder)"
    return OSError(error.errno or errno.EIO, error.strerror or str(error), where)
