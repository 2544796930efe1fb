// Sums over particles that do not depend on the order of their terms: in 64-bit integers adding is associative, so the order
// of the atomic operations leaves no trace. Why: docs/decisions/0004-fixed-point-sums.md.
//
// A particle's share of a node is at most largest, and a world has count particles. The unit is the power of two 2^-k with
//
//     count largest 2^k < 2^62                                                                                           (A7)
//
// so that no sum overflows. A warp still adds up in floats what it sends to a node, in an order that is always the same.
namespace softmpm {

CUDA_CALLABLE inline int bits_of(float x)
{
    union {
        float real;
        int bits;
    } u;
    u.real = x;
    return u.bits;
}

CUDA_CALLABLE inline float real_of(int bits)
{
    union {
        int bits;
        float real;
    } u;
    u.bits = bits;
    return u.real;
}

// 2^e in two factors: alone it may lie beyond the floats
struct Power {
    float a, b;
    CUDA_CALLABLE inline explicit Power(int e)
        : a(real_of((e / 2 + 127) << 23))
        , b(real_of((e - e / 2 + 127) << 23))
    {
    }
    CUDA_CALLABLE inline float operator()(float x) const { return x * a * b; }
};

// k of (A7)
CUDA_CALLABLE inline int exponent(int count, float largest) { return 61 + 127 - (bits_of(float(count) * largest) >> 23); }
constexpr int NOT_FINITE = 61 + 127 - 255;  // what comes out if largest is not finite

CUDA_CALLABLE inline long long nearest(float x)
{
#if defined(__CUDA_ARCH__)
    return __float2ll_rn(x);
#else
    double d = x;
    return (long long)(d < 0.0 ? d - 0.5 : d + 0.5);
#endif
}

CUDA_CALLABLE inline void add_fixed(long long* p, long long value)
{
#if defined(__CUDA_ARCH__)
    if (value != 0)
        atomicAdd(reinterpret_cast<unsigned long long*>(p), (unsigned long long)value);
#else
    *p += value;
#endif
}

// One node, and its units. In two dimensions it is (x, y, m, 0), as in scatter.h.
template <unsigned DIM> struct FixedCell {
    long long* at;
    Power b, m;
    CUDA_CALLABLE inline FixedCell operator+(int n) const { return { at + n, b, m }; }
};

// Nodes of all worlds
template <unsigned DIM> struct Fixed {
    long long* at;  // four for each node
    const float* largest;  // of b + A o and of m, for each world
    int nodes;  // of one world
    int count;  // particles of one world
    CUDA_CALLABLE inline Fixed operator+(long long n) const { return { at + n, largest, nodes, count }; }
};

template <unsigned DIM> CUDA_CALLABLE inline FixedCell<DIM> cell(const Fixed<DIM>& f, int first)
{
    const float* largest = f.largest + 2 * (first / f.nodes);
    Power b(exponent(f.count, largest[0])), m(exponent(f.count, largest[1]));
    return { f.at + 4 * (long long)first, b, m };
}

template <unsigned DIM> CUDA_CALLABLE inline void add(const FixedCell<DIM>& c, float x, float y, float z, float m)
{
    add_fixed(c.at, nearest(c.b(x)));
    add_fixed(c.at + 1, nearest(c.b(y)));
    add_fixed(c.at + 2, nearest(DIM == 2 ? c.m(z) : c.b(z)));
    if constexpr (DIM == 3)
        add_fixed(c.at + 3, nearest(c.m(m)));
}

// (A1) into fixed point; as scatter.
template <unsigned DIM>
CUDA_CALLABLE inline void scatter_fixed(
    const Fixed<DIM>& node, const wp::vec_t<DIM, int>& shape, int first, const wp::vec_t<DIM, float>& g,
    const wp::vec_t<DIM, float>& b, const wp::mat_t<DIM, DIM, float>& A, float m)
{
#if defined(__CUDA_ARCH__)
    add_warp(node, shape, first, g, b, A, m);
#else
    add_each(node, shape, first, g, b, A, m);
#endif
}

// The sum of node i, which is cleared. Not a number if a share of its world was not finite.
template <unsigned DIM> CUDA_CALLABLE inline wp::vec_t<4, float> take_fixed(const Fixed<DIM>& f, int i)
{
    const float* largest = f.largest + 2 * (i / f.nodes);
    int b = exponent(f.count, largest[0]), m = exponent(f.count, largest[1]);
    Power momentum(-b), mass(-m);
    if (b == NOT_FINITE || m == NOT_FINITE)
        momentum.a = mass.a = real_of(0x7fc00000);
    struct alignas(16) Pair {
        long long a, b;
    };
    Pair* p = reinterpret_cast<Pair*>(f.at + 4 * (long long)i);
    Pair xy = p[0], zm = p[1];
    if (xy.a | xy.b | zm.a | zm.b)  // most nodes are empty
        p[0] = p[1] = { 0, 0 };
    return wp::vec_t<4, float>(
        momentum(float(xy.a)), momentum(float(xy.b)), DIM == 2 ? mass(float(zm.a)) : momentum(float(zm.a)),
        DIM == 2 ? 0.0f : mass(float(zm.b)));
}

// Raise largest[slot] to the value, to infinity if it is not finite. The whole warp must come here together: those that
// have nothing with a negative slot. Bits of floats that are not negative have the order of the floats.
CUDA_CALLABLE inline void raise_largest(float* largest, int slot, float value)
{
    int bits = slot < 0 ? 0 : value < real_of(0x7f800000) ? bits_of(value) : 0x7f800000;
#if defined(__CUDA_ARCH__)
    int lead = __shfl_sync(0xffffffffu, slot, 0);
    if (__all_sync(0xffffffffu, slot == lead || slot < 0)) {
        for (int step = LANES / 2; step > 0; step /= 2)
            bits = max(bits, __shfl_xor_sync(0xffffffffu, bits, step));
        if (threadIdx.x % LANES != 0)
            return;
    }
    if (slot >= 0 && bits > *reinterpret_cast<volatile int*>(largest + slot))
        atomicMax(reinterpret_cast<int*>(largest + slot), bits);
#else
    if (slot >= 0 && bits > bits_of(largest[slot]))
        largest[slot] = real_of(bits);
#endif
}

}  // namespace softmpm
