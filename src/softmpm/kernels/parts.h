// Parts of a launch on the CPU, which threads run at the same time. Warp counts the threads of a launch from 0 on; in the bounds of a part
// `coord_mult`, otherwise 1, is one more than its first thread.
#if !defined(builtin_tid1d) || !defined(builtin_tid2d) || !defined(builtin_tid3d)
#error "This version of Warp numbers the threads of a launch in another way."
#endif
#undef builtin_tid1d
#undef builtin_tid2d
#undef builtin_tid3d
#define builtin_tid1d() softmpm::tid(task_index, dim)
#define builtin_tid2d(i, j) softmpm::tid(i, j, task_index, dim)
#define builtin_tid3d(i, j, k) softmpm::tid(i, j, k, task_index, dim)

namespace softmpm {

// A division takes longer than the rest of many a node, and most scenes have one world.
inline int digit(size_t& index, size_t length)
{
    const size_t rest = index < length ? 0 : length == 1 ? index : index / length;
    const int last = int(index - rest * length);
    index = rest;
    return last;
}

inline int tid(size_t index, const wp::launch_bounds_t<1>& bounds) { return int(index + bounds.coord_mult - 1); }

inline void tid(int& i, int& j, size_t index, const wp::launch_bounds_t<2>& bounds)
{
    index += bounds.coord_mult - 1;
    j = digit(index, bounds.shape[1]);
    i = int(index);
}

inline void tid(int& i, int& j, int& k, size_t index, const wp::launch_bounds_t<3>& bounds)
{
    index += bounds.coord_mult - 1;
    k = digit(index, bounds.shape[2]);
    j = digit(index, bounds.shape[1]);
    i = int(index);
}

// A launch of a program, see parts.py.
struct Row {
    void (*kernel)(void*, void*);
    void* arguments;
    char* bounds;  // of the first part
    wp::int64 bytes;  // of the bounds of a part
    wp::int64 parts;
    wp::int64 joint;  // the next launch may begin before this one is done
};

using GiveWay = int (*)();

// Parts that were taken of each section, and done of all, on a cache line of their own. A thread begins with the same section in every
// launch and finds there what it has written before; then it helps others.
constexpr int SECTIONS = SOFTMPM_SECTIONS;
struct alignas(64) Count {
    int taken[SECTIONS], done;
};

inline void take_parts(const Row& row, Count& count, int section)
{
    int done = 0;
    for (int k = 0; k < SECTIONS; ++k, section = section + 1 < SECTIONS ? section + 1 : 0) {
        const wp::int64 begin = row.parts * section / SECTIONS, end = row.parts * (section + 1) / SECTIONS;
        int* taken = count.taken + section;
        while (begin + __atomic_load_n(taken, __ATOMIC_RELAXED) < end) {
            const wp::int64 part = begin + __atomic_fetch_add(taken, 1, __ATOMIC_RELAXED);
            if (part < end) {
                row.kernel(row.bounds + part * row.bytes, row.arguments);
                ++done;
            }
        }
    }
    if (done > 0)
        __atomic_fetch_add(&count.done, done, __ATOMIC_RELEASE);
}

// Take part in the launches from `first` to `last` of a program. Helpers leave it early if `stop` is set, as it is after the caller
// waited long for them several times: then others use the cores.
inline void run_parts(
    const Row* program, Count* counts, int* stop, GiveWay give_way, bool helper, int section, int first, int last)
{
    for (int k = first, begin = first, long_waits = 0; k < last; ++k) {
        if (helper && __atomic_load_n(stop, __ATOMIC_RELAXED))
            return;
        const Row& row = program[k];
        take_parts(row, counts[k], section);
        if (row.joint && k + 1 < last)
            continue;
        for (; begin <= k; ++begin)
            for (int turn = 0; __atomic_load_n(&counts[begin].done, __ATOMIC_ACQUIRE) < program[begin].parts; ++turn) {
                if (turn > 100000)
                    give_way();
                if (turn == 105000 && !helper && ++long_waits == 4)
                    __atomic_store_n(stop, 1, __ATOMIC_RELAXED);
            }
    }
}
}  // namespace softmpm

namespace wp {

// Status words. Warp's own function serves one thread.
template <> inline int64 atomic_min(int64* address, int64 value)
{
    int64 old = __atomic_load_n(address, __ATOMIC_RELAXED);
    while (value < old && !__atomic_compare_exchange_n(address, &old, value, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) { }
    return old;
}
}  // namespace wp
