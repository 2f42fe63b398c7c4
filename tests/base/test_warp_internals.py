"""Warp below its public interface: one file uses it, and kept hashes of kernels are those that Warp computes."""

from pathlib import Path

import warp as wp

import warpcloth as wc
from warpcloth.kernels.transpose import scatter
from warpcloth.scenes import hanging


def test_one_file_uses_what_is_private_in_warp():
    root = Path(wc.__file__).parent
    files = [*root.rglob("*.py"), *(root / "kernels").rglob("*.py")]  # kernels/ is a link
    assert {file.name for file in files if "wp._src" in file.read_text(encoding="utf-8")} == {"warp_internals.py"}


def test_kept_hashes_are_those_of_warp(monkeypatch):
    """So that compiled kernels in the cache are found."""
    loaded, load = {}, wp.Module.load

    def noting(module, *arguments, **options):
        loaded[module.name] = module
        return load(module, *arguments, **options)

    monkeypatch.setattr(wp.Module, "load", noting)
    wc.Newton(substeps=4).bind(hanging.scene(n=4).build())
    hasher, codegen = wp._src.context.ModuleHasher, wp._src.codegen
    monkeypatch.setattr(hasher, "hash_adjoint", hasher.hash_adjoint.__wrapped__)
    monkeypatch.setattr(codegen, "iter_call_callable_arg_targets", codegen.iter_call_callable_arg_targets.__wrapped__)
    assert any(
        scatter.__module__ in str(kernel.func.__module__) for each in loaded.values() for kernel in each._get_live_kernels()
    )
    for module in loaded.values():
        for block, kept in module.hashers.items():
            kernels = list(kept.unique_kernels.values())
            assert hasher(kernels, module.resolved_options[block]).hash == kept.hash, module.name
