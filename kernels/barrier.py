"""A barrier in recorded graphs on the CPU, where the threads that replay one graph each wait for one another."""

from functools import cache

import warp as wp

# Indices into the state of a barrier, each in its own cache line: the number of threads that arrived, the number of times that
# all did, and whether the barrier is abandoned, so that no thread waits. The last is the length of the state.
ARRIVED, RELEASED, ABANDONED, NUMBERS = 0, 16, 32, 48
# A thread polls this often, for some microseconds, then yields its core: the thread that it waits for may need one.
_LOOKS = 4000


@wp.func_native(f"""
int32_t* arrived = barrier.data + {ARRIVED};
int32_t* released = barrier.data + {RELEASED};
int32_t* abandoned = barrier.data + {ABANDONED};
int32_t before = __atomic_load_n(released, __ATOMIC_ACQUIRE);
if (__atomic_add_fetch(arrived, 1, __ATOMIC_ACQ_REL) == threads) {{
    __atomic_store_n(arrived, 0, __ATOMIC_RELAXED);
    __atomic_store_n(released, before + 1, __ATOMIC_RELEASE);
    return;
}}
int32_t looks = 0;
while (__atomic_load_n(released, __ATOMIC_ACQUIRE) == before && !__atomic_load_n(abandoned, __ATOMIC_RELAXED)) {{
    if (++looks > {_LOOKS}) ((void (*)())leave)();
}}
""")
def wait_for_all(threads: int, leave: wp.uint64, barrier: wp.array(dtype=wp.int32)): ...


@cache
def wait_at_barrier():
    """Kernel of one thread: returns when ``threads`` threads launched it. ``leave`` is a C function that yields the core."""

    @wp.kernel(module="unique", enable_backward=False)
    def wait_all(
        # parameters
        threads: int,
        leave: wp.uint64,
        # in and out
        barrier: wp.array(dtype=wp.int32),
    ):
        wait_for_all(threads, leave, barrier)

    return wait_all
