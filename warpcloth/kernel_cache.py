"""Warp's cache of compiled kernels: what is broken there is compiled again, and a cache that takes nothing is said."""

import errno
import os
import shutil
import tempfile
from functools import wraps

_ROOM = 2**22  # bytes that the source and the binary of a kernel have to find


def mend():
    """Has Warp look after its cache where it loads kernels, of any module.

    A process that was killed, or a disk that was full, may leave a binary or its description cut, which Warp then fails to load
    each time: here the files of the module are removed, and it is compiled once more. Without room for a binary LLVM ends the
    process: here that is an error, before.
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
            # A binary may be whole for the linker, and lack what it should have; CUDA notices that itself.
            if device.is_cpu and any(loaded.get_kernel_hooks(kernel).forward is None for kernel in list(loaded.kernel_names)):
                raise RuntimeError(f"{folder}: a kernel is not there")
            return loaded
        except Exception:  # of many kinds; if it was not for these files it comes again
            refuse_full(os.path.dirname(folder))
            shutil.rmtree(folder, ignore_errors=True)
            module.execs.pop(key, None)
            module.mark_modified()
        return load(module, device, block_dim, *arguments, **options)

    return mended


def refuse_full(cache):
    """Refuses a folder that takes no binary.

    Raises:
        OSError: It is full or cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=cache) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        raise described(error, cache) from None


def described(error, cache):
    """The error of a cache, with what it is."""
    where = f"{cache}, where Warp keeps compiled kernels (WARP_CACHE_PATH names another folder)"
    return OSError(error.errno or errno.EIO, error.strerror or str(error), where)
