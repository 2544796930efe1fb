// A warp on the CPU: 32 threads that wait for each other where the lanes of a warp do. Runs the sums of scatter.h as a GPU would.
#include <algorithm>
#include <barrier>
#include <cstring>
#include <mutex>
#include <thread>
#include <vector>

#define __CUDA_ARCH__ 800  // before sm_90: numbers are added one by one, no PTX
#define CUDA_CALLABLE
#define WP_TILE_BLOCK_DIM 32
#define __shared__ static

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
template <typename T> T __ldg(const T* p) { return *p; }

thread_local struct {
    int x;
} threadIdx;
std::barrier<> lanes_meet(32);
inline void __syncwarp() { lanes_meet.arrive_and_wait(); }

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

// Add what the lanes give to the nodes; arrays of 32 each. How many sums were sent.
template <int DIM>
int add(float* node, const int* shape, int crew, const int* first, const float* g, const float* b, const float* A, const float* m)
{
    std::vector<std::thread> warp;
    wp::vec_t<DIM, int> size;
    std::copy_n(shape, DIM, size.c);
    reductions = 0;
    for (int lane = 0; lane < 32; ++lane)
        warp.emplace_back([=] {
            wp::vec_t<DIM, float> g_, b_;
            wp::mat_t<DIM, DIM, float> A_;
            std::copy_n(g + DIM * lane, DIM, g_.c);
            std::copy_n(b + DIM * lane, DIM, b_.c);
            std::copy_n(A + DIM * DIM * lane, DIM * DIM, &A_.data[0][0]);
            threadIdx.x = lane;
            softmpm::add_warp(node, size, crew, first[lane], g_, b_, A_, m[lane]);
        });
    for (auto& thread : warp)
        thread.join();
    return reductions / 4;
}

extern "C" int add2(float* n, const int* s, int c, const int* f, const float* g, const float* b, const float* A, const float* m)
{
    return add<2>(n, s, c, f, g, b, A, m);
}
extern "C" int add3(float* n, const int* s, int c, const int* f, const float* g, const float* b, const float* A, const float* m)
{
    return add<3>(n, s, c, f, g, b, A, m);
}
