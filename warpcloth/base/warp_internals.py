"""All that this package changes or reads in Warp below its public interface, each with what it saves.

Every change keeps the original as ``__wrapped__``. A version of Warp without a function that would be changed is left as it is.
CPU times are of one core of an AMD EPYC with Warp 1.19, medians of four.
"""

import hashlib
import os
import shutil
from functools import cache, wraps

from .kernel_cache import HEADERS, refuse_full

_OWN = __name__.partition(".")[0] + "."
_INSTANTIATE = "-fpch-instantiate-templates"


def change_warp():
    """Makes Warp hash kernels once, share parsed headers, and repair its cache of compiled kernels."""
    import warp as wp

    _hash_once(wp._src.context, wp._src.codegen, wp._src.types.is_warp_function_annotation)
    _share_headers(wp.config, wp._src.context.Runtime)
    _change(wp.Module, "load", _repairing)


def hash_of_function(function):
    """Returns Warp's hash of a function: of its source, the values that it refers to, and the functions that it calls.

    Raises:
        ValueError: This version of Warp has no such hash.
    """
    import warp as wp

    try:
        hasher = wp._src.context.ModuleHasher
    except AttributeError:
        raise ValueError(f"this version of Warp, {wp.__version__}, gives no hash of functions, which a key needs") from None
    return hasher([], {}).hash_function(function)


def _change(owner, name, wrap):
    """Replaces a function of Warp by ``wrap(function)``, once and if there is one."""
    function = getattr(owner, name, None)
    if function is not None and not hasattr(function, "__wrapped__"):
        setattr(owner, name, wraps(function)(wrap(function)))


# --- hashes of kernels: the first bind of a solver takes 0.69 of the CPU time (XPBD on hanging, 72 instead of 105 ms), 0.72
# (Explicit), 0.81 (Newton) and 0.87 (Newton on drape with self-contact, where loading modules takes most).


def _hash_once(context, codegen, is_function):
    """Makes Warp keep the hash of each kernel and function of this package, whose constants do not change.

    The name of a compiled module has a hash of its kernels, and of the functions and constants that they use. Warp computes it
    from the parsed source whenever it registers or loads a kernel, again for each function that a kernel calls. Each function
    that a kernel calls is also searched for functions passed as arguments, here only if it takes one. The hashes are the same.
    Each of the two alone gives up about half of what both save.
    """

    def kept(hash_adjoint):
        def kept_hash(hasher, adjoint):
            found = adjoint.__dict__.get("_warpcloth_hash")
            if found is None:
                found = hash_adjoint(hasher, adjoint)
                if adjoint.func.__module__.startswith(_OWN) and not adjoint.has_unresolved_static_expressions:
                    adjoint._warpcloth_hash = found
            return found

        return kept_hash

    def skipping(search):
        def search_if_taken(adjoint, function, *given):
            if isinstance(function, context.Function) and not function.is_builtin():
                all_of_name = function, *function.user_overloads.values(), *function.user_templates.values()
                if not any(is_function(kind) for each in all_of_name for kind in each.input_types.values()):
                    return ()
            return search(adjoint, function, *given)

        return search_if_taken

    _change(getattr(context, "ModuleHasher", None), "hash_adjoint", kept)
    _change(codegen, "iter_call_callable_arg_targets", skipping)


# --- parsed headers: the first kernel that a process compiles takes 0.06 instead of 1.26 s of the CPU.


def _share_headers(config, runtime_class):
    """Makes Warp keep its parsed headers in the kernel cache, for kernels on the CPU, where all processes share them.

    Every kernel includes Warp's headers, which Warp parses once in each thread of each process. The shared ones also
    instantiate the templates that they use, which the compiler would otherwise repeat for each kernel (0.06 instead of 0.10 s).
    The generated code is the same. `wp.clear_kernel_cache` removes the folder.
    """
    flags = config.cpu_compiler_flags
    if flags is not None and _INSTANTIATE not in flags:
        config.cpu_compiler_flags = f"{flags} {_INSTANTIATE}"

    def shared(folder_of_thread):
        def folder(runtime):
            if runtime.llvm is None:
                return folder_of_thread(runtime)
            os.makedirs(headers_folder(), exist_ok=True)
            return headers_folder()

        return folder

    _change(runtime_class, "get_clang_pch_dir", shared)


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


# --- the cache of compiled kernels: this saves no time. Without it, a process that is killed while it compiles leaves a cache
# with which every later run ends in an error of the linker, until the user removes the folder.


def _repairing(load):
    """Loads a module, and compiles it again if its files are truncated, as a killed process or a full disk leaves them.

    LLVM ends the process if the disk has no room for a binary, so that is checked before.
    """

    def repairing(module, device, block_dim=None, *arguments, **options):
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

    return repairing
