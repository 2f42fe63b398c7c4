"""Makes Warp hash the kernels of this package once.

The name of a compiled module has a hash of its kernels, and of the functions and constants that they use. Warp computes it from
the parsed source whenever it registers or loads a kernel, again for each function that a kernel calls. That was a quarter of
the time to bind a solver for the first time.
"""

from functools import wraps

_OWN = __name__.partition(".")[0] + "."


def hash_once():
    """Makes Warp keep the hash of each kernel and function of this package, whose constants do not change.

    It also skips the search for functions passed as arguments where the called function takes none. The hashes are the same.
    A version of Warp without these functions is left alone.
    """
    import warp as wp

    context, codegen = wp._src.context, wp._src.codegen
    hasher, search = getattr(context, "ModuleHasher", None), getattr(codegen, "iter_call_callable_arg_targets", None)
    if hasattr(hasher, "hash_adjoint") and not hasattr(hasher.hash_adjoint, "__wrapped__"):
        hasher.hash_adjoint = _kept(hasher.hash_adjoint)
    if search is not None and not hasattr(search, "__wrapped__"):
        codegen.iter_call_callable_arg_targets = _skipping(search, context.Function, wp._src.types.is_warp_function_annotation)


def _kept(hash_adjoint):
    @wraps(hash_adjoint)
    def kept(hasher, adjoint):
        found = adjoint.__dict__.get("_warpcloth_hash")
        if found is None:
            found = hash_adjoint(hasher, adjoint)
            if adjoint.func.__module__.startswith(_OWN) and not adjoint.has_unresolved_static_expressions:
                adjoint._warpcloth_hash = found
        return found

    return kept


def _skipping(search, Function, is_function):
    @wraps(search)
    def skipping(adjoint, function, *given):
        if isinstance(function, Function) and not function.is_builtin():
            all_of_name = function, *function.user_overloads.values(), *function.user_templates.values()
            if not any(is_function(kind) for each in all_of_name for kind in each.input_types.values()):
                return ()
        return search(adjoint, function, *given)

    return skipping
