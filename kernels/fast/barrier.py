"""A place within recorded graphs where threads that replay one each wait for one another, on the CPU."""

from functools import cache

import warp as wp

# Of an array: threads that have come, how often all had, and whether they wait no more; each in a cache line of its own.
COME, MET, ABANDONED, NUMBERS = 0, 16, 32, 48
# Looks before the core is left to others, some microseconds: a thread that is waited for may have none.
_LOOKS = 4000


@wp.func_native(f"""
int32_t* come = meeting.data + {COME};
int32_t* met = meeting.data + {MET};
int32_t* abandoned = meeting.data + {ABANDONED};
int32_t before = __atomic_load_n(met, __ATOMIC_ACQUIRE);
if (__atomic_add_fetch(come, 1, __ATOMIC_ACQ_REL) == threads) {{
    __atomic_store_n(come, 0, __ATOMIC_RELAXED);
    __atomic_store_n(met, before + 1, __ATOMIC_RELEASE);
    return;
}}
int32_t looks = 0;
while (__atomic_load_n(met, __ATOMIC_ACQUIRE) == before && !__atomic_load_n(abandoned, __ATOMIC_RELAXED)) {{
    if (++looks > {_LOOKS}) ((void (*)())leave)();
}}
""")
def wait_for_all(threads: int, leave: wp.uint64, meeting: wp.array(dtype=wp.int32)): ...


@cache
def meet():
    """Kernel of one thread: ends when ``threads`` threads have launched it. ``leave`` is a C function that yields the core."""

    @wp.kernel(module="unique", enable_backward=False)
    def meet_all(
        threads: int,
        leave: wp.uint64,
        # in and out
        meeting: wp.array(dtype=wp.int32),
    ):
        wait_for_all(threads, leave, meeting)

    return meet_all


@cache
def carry(dtype):
    """Kernel over vectors: out[targets[k]] = source[sources[k]]."""

    @wp.kernel(module="unique", enable_backward=False)
    def carry_each(
        sources: wp.array(dtype=wp.int32),
        targets: wp.array(dtype=wp.int32),
        source: wp.array(dtype=dtype),
        # out
        out: wp.array(dtype=dtype),
    ):
        k = wp.tid()
        out[targets[k]] = source[sources[k]]

    return carry_each
