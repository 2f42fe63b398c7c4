"""Repairs Warp's cache of compiled kernels: broken files are compiled again, and a cache that cannot be written is an error."""

import errno
import os
import shutil
import tempfile
from functools import wraps

_ROOM = 2**22  # free bytes that the source and the binary of a kernel need


def mend():
    """Makes Warp repair its cache when it loads a module.

    A killed process or a full disk may leave a truncated binary or description, which Warp then fails to load every time. In
    that case the files of the module are removed and it is compiled once more. LLVM ends the process if there is no room for a
    binary; this is checked first and raised as an error.
    """
    import warp as wp

    if not hasattr(wp.Module.load, "__wrapped__"):
        wp.Module.load = _mended(wp.Module.load)


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
            # The linker may accept a binary that lacks a kernel; CUDA notices that itself.
            if device.is_cpu and any(loaded.get_kernel_hooks(kernel).forward is None for kernel in list(loaded.kernel_names)):
                raise RuntimeError(f"{folder}: a kernel is not there")
            return loaded
        except Exception:  # many kinds; if these files are not the cause it is raised again
            refuse_full(os.path.dirname(folder))
            shutil.rmtree(folder, ignore_errors=True)
            module.execs.pop(key, None)
            module.mark_modified()
        return load(module, device, block_dim, *arguments, **options)

    return mended


def refuse_full(cache):
    """Refuses a folder that has no room for a binary.

    Raises:
        OSError: The folder is full or cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=cache) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise described(error, cache) from None


def described(error, cache):
    """Returns the error of a cache, with a name for its folder."""
    where = f"{cache}, where Warp keeps compiled kernels (WARP_CACHE_PATH names another folder)"
    return OSError(error.errno or errno.EIO, error.strerror or str(error), where)
