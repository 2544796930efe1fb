// A warp on the CPU: 32 threads that wait for each other where the lanes of a warp do. Runs the sums of scatter.h as a GPU would.
#include <algorithm>
#include <barrier>
#include <bit>
#include <cstring>
#include <mutex>
#include <thread>
#include <vector>

#define __CUDA_ARCH__ 800  // before sm_90: numbers are added one by one, no PTX
#define CUDA_CALLABLE
#define WP_TILE_BLOCK_DIM 32
#define __shared__ static

using std::max;
using std::min;

struct float4 {
    float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return { x, y, z, w }; }
template <typename To, typename From> To bits(From from)
{
    To to;
    std::memcpy(&to, &from, sizeof to);
    return to;
}
inline float __int_as_float(int i) { return bits<float>(i); }
inline int __float_as_int(float f) { return bits<int>(f); }

template <typename T> T __ldcg(const T* p) { return *p; }
template <typename T> T __ldg(const T* p) { return *p; }

thread_local struct {
    int x;
} threadIdx;
std::barrier<>* lanes_meet;  // those that take part
inline void __syncwarp(unsigned = 0xffffffffu) { lanes_meet->arrive_and_wait(); }
inline int __popc(unsigned bits) { return std::popcount(bits); }
int told[32];
inline int __shfl_sync(unsigned, int value, int lane)
{
    told[threadIdx.x] = value;
    __syncwarp();
    int heard = told[lane];
    __syncwarp();
    return heard;
}

template <typename T> T exchanged(T value, int lane)  // with what all others tell
{
    return T(__shfl_sync(0, int(value), lane));
}
inline unsigned __shfl_up_sync(unsigned, unsigned value, int by)
{
    int lane = threadIdx.x;
    return exchanged(value, lane < by ? lane : lane - by);
}
inline unsigned __shfl_xor_sync(unsigned, unsigned value, int mask) { return exchanged(value, int(threadIdx.x) ^ mask); }
inline unsigned __ballot_sync(unsigned, bool vote)
{
    unsigned votes = 0;
    told[threadIdx.x] = vote;
    __syncwarp();
    for (int lane = 0; lane < 32; ++lane)
        votes |= unsigned(told[lane]) << lane;
    __syncwarp();
    return votes;
}

inline bool __all_sync(unsigned, bool vote) { return __ballot_sync(0, vote) == ~0u; }

std::mutex adding;
int reductions;  // sums of a node that were sent, four numbers each
template <typename T> void atomicAdd(T* p, T value)
{
    std::lock_guard<std::mutex> alone(adding);
    *p += value;
    ++reductions;
}

namespace wp {
template <unsigned N, typename T> struct vec_t {
    T c[N];
    vec_t() = default;
    template <typename... Ts> vec_t(Ts... values) : c { values... } { }
    T operator[](int i) const { return c[i]; }
};
template <unsigned N, unsigned M, typename T> struct mat_t {
    T data[N][M];
};
}

#include "scatter.h"

// Run a function of the lane on the first ``count`` lanes at once.
template <typename Work> void run(int count, Work work)
{
    std::vector<std::thread> warp;
    std::barrier<> meeting(count);
    lanes_meet = &meeting;
    for (int lane = 0; lane < count; ++lane)
        warp.emplace_back([=] {
            threadIdx.x = lane;
            work(lane);
        });
    for (auto& thread : warp)
        thread.join();
}

// Add what the lanes give to the nodes; arrays of 32 each. How many sums were sent.
template <int DIM>
int add(float* node, const int* shape, const int* first, const float* g, const float* b, const float* A, const float* m)
{
    wp::vec_t<DIM, int> size;
    std::copy_n(shape, DIM, size.c);
    reductions = 0;
    run(32, [=](int lane) {
        wp::vec_t<DIM, float> g_, b_;
        wp::mat_t<DIM, DIM, float> A_;
        std::copy_n(g + DIM * lane, DIM, g_.c);
        std::copy_n(b + DIM * lane, DIM, b_.c);
        std::copy_n(A + DIM * DIM * lane, DIM * DIM, &A_.data[0][0]);
        softmpm::add_warp(node, size, first[lane], g_, b_, A_, m[lane]);
    });
    return reductions / 4;
}

extern "C" int add2(float* n, const int* s, const int* f, const float* g, const float* b, const float* A, const float* m)
{
    return add<2>(n, s, f, g, b, A, m);
}
extern "C" int add3(float* n, const int* s, const int* f, const float* g, const float* b, const float* A, const float* m)
{
    return add<3>(n, s, f, g, b, A, m);
}

// Rank of each lane's particle among those of its warp.
extern "C" void sorted_places(int* place, const int* first)
{
    run(32, [=](int lane) { place[lane] = softmpm::sorted_place(first[lane]); });
}

// The numbers of the first ``count`` lanes' particles, nine each, to their rows.
extern "C" void spread9(float* out, const int* row, const float* value, int count)
{
    run(count, [=](int lane) { softmpm::spread<9>(out, row[lane], value + 9 * lane, 64 + lane, 64 + count); });
}
