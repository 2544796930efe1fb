// Scatter of the contributions of particles to the nodes of a grid; loads of nodes and of packed particles. Derivation: docs/math/scatter.md.
//
// A particle gives node o of its 3^DIM stencil, o along each axis in {-1, 0, 1} from the middle node, the vector
//
//     w_o (b + A o, m),   w_o = product over the axes of w(o_a, g_a)                                 (A1)
//
// with g the distance from the middle node in cells, -1/2 <= g < 1/2. Both scatters have this form: momentum and mass of the
// forward step, and the adjoint of the nodes' velocity (m = 0). Particles are sorted by cell, so neighbours in a warp mostly
// share their nodes. The warp therefore turns the sum around: its lanes, or the first of them, have a particle each and write its
// (b, A, m, g, g^2) to shared memory in the order of the cells, in 3D two weights along z in place of g_z; then three groups of nine lanes
// own the nodes, walk through a third of the particles each, add up in registers while the cell stays the same, and send one 16-byte
// reduction per node and cell. Lanes 27 to 31 own nothing.
namespace softmpm {

constexpr int LANES = 32;  // particles of a block of packed rows, and of a warp

// Where the four numbers of a node stand. A sum goes to plain nodes or, with overloads of cell and add, to those of fixed_point.h.
template <typename T> CUDA_CALLABLE inline T* cell(T* node, int i) { return node + 4 * (long long)i; }

// g^2, rounded so that the weights made of it are exact and add up to one, see spline.py.
template <typename T> CUDA_CALLABLE inline T square(T g) { return (g * g + T(0.5)) - T(0.5); }

// Weights of the three nodes along an axis.
template <typename T> CUDA_CALLABLE inline void weights(T g, T* w)
{
    T outer = T(0.125) + T(0.5) * square(g);
    w[0] = outer - T(0.5) * g;
    w[1] = T(0.75) - square(g);
    w[2] = outer + T(0.5) * g;
}

#if defined(__CUDA_ARCH__)

template <typename T> struct Four {
    T x, y, z, w;
    CUDA_CALLABLE inline Four operator+(const Four& o) const { return { x + o.x, y + o.y, z + o.z, w + o.w }; }
    CUDA_CALLABLE inline Four operator-(const Four& o) const { return { x - o.x, y - o.y, z - o.z, w - o.w }; }
    CUDA_CALLABLE inline Four operator*(T f) const { return { x * f, y * f, z * f, w * f }; }
};

template <typename T> CUDA_CALLABLE inline Four<T> load(const T* p) { return { p[0], p[1], p[2], p[3] }; }
template <> CUDA_CALLABLE inline Four<float> load(const float* p)
{
    float4 v = *reinterpret_cast<const float4*>(p);  // the kernel before may still write: not as read-only memory
    return { v.x, v.y, v.z, v.w };
}
template <typename T> CUDA_CALLABLE inline Four<T> load_constant(const T* p) { return load(p); }
template <> CUDA_CALLABLE inline Four<float> load_constant(const float* p)
{
    float4 v = __ldg(reinterpret_cast<const float4*>(p));
    return { v.x, v.y, v.z, v.w };
}

template <typename T> CUDA_CALLABLE inline void add(T* p, T x, T y, T z, T m)
{
    atomicAdd(p, x);
    atomicAdd(p + 1, y);
    atomicAdd(p + 2, z);
    atomicAdd(p + 3, m);
}
#if __CUDA_ARCH__ >= 900
template <> CUDA_CALLABLE inline void add(float* p, float x, float y, float z, float m)
{
    asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(p), "f"(x), "f"(y), "f"(z), "f"(m) : "memory");
}
#endif

// w(o, g) = level + bend g^2 + lean g, for the o that a lane owns, with the square of above
struct Weight {
    float level, bend, lean;
    CUDA_CALLABLE inline explicit Weight(int o)
        : level(o == 0 ? 0.75f : 0.125f)
        , bend(o == 0 ? -1.0f : 0.5f)
        , lean(0.5f * float(o))
    {
    }
    CUDA_CALLABLE inline float operator()(float g, float square) const { return level + bend * square + lean * g; }
};

// Rank of this lane's particle among those of its warp, sorted by their first nodes; lanes without a particle, which come last,
// stay last. An order of all particles grows stale as they move, but those of a warp stay near each other: re-sorted they still
// share their nodes.
CUDA_CALLABLE inline int sorted_place(int first)
{
    constexpr unsigned ALL = 0xffffffffu;
    __shared__ int place[WP_TILE_BLOCK_DIM];
    int lane = threadIdx.x & (LANES - 1);
    unsigned key = first, before = __shfl_up_sync(ALL, key, 1);
    if (__all_sync(ALL, lane == 0 || before <= key))
        return lane;
    unsigned lowest = key;
    for (int step = 1; step < LANES; step *= 2)
        lowest = min(lowest, __shfl_xor_sync(ALL, lowest, step));
    // A bitonic sort of lanes. Nodes too far from the lowest one to be told apart stay in the order of their lanes.
    unsigned all = min(key - lowest, ~0u / LANES) * LANES + lane;
    for (int size = 2; size <= LANES; size *= 2)
        for (int step = size / 2; step > 0; step /= 2) {
            unsigned other = __shfl_xor_sync(ALL, all, step);
            bool lower = ((lane & step) == 0) == ((lane & size) == 0);
            all = lower ? min(all, other) : max(all, other);
        }
    place[threadIdx.x - lane + all % LANES] = lane;
    __syncwarp();
    return place[threadIdx.x];
}

// What a lane owns of the nodes around the cell that the walk is in, and how a particle lies in shared memory for it.
template <int DIM, class Sink> struct Owner;

// Three dimensions: a column of three nodes along z, whose sums are carried to the next cell if that is the one above.
template <class Sink> struct Owner<3, Sink> {
    static constexpr int WIDTH = 5;  // float4 per particle: 80 bytes, free of bank conflicts when sorted
    Weight wx, wy;
    float fx, fy;
    Sink origin;
    int current;
    float4 below, middle, above;

    CUDA_CALLABLE static inline void write(
        float4* q, int first, const wp::vec_t<3, float>& g, const wp::vec_t<3, float>& b, const wp::mat_t<3, 3, float>& A, float m)
    {
        float wz[3];
        weights(g[2], wz);
        q[0] = make_float4(b[0], b[1], b[2], m);
        q[1] = make_float4(A.data[0][0], A.data[1][0], A.data[2][0], g[0]);
        q[2] = make_float4(A.data[0][1], A.data[1][1], A.data[2][1], g[1]);
        q[3] = make_float4(A.data[0][2], A.data[1][2], A.data[2][2], wz[0]);
        q[4] = make_float4(wz[2], square(g[0]), square(g[1]), __int_as_float(first));
    }
    CUDA_CALLABLE static inline int first(const float4* q) { return __float_as_int(q[4].w); }

    CUDA_CALLABLE inline Owner(Sink node, const wp::vec_t<3, int>& shape, int ox, int oy, int start)
        : wx(ox)
        , wy(oy)
        , fx(float(ox))
        , fy(float(oy))
        , origin(node + 4 * (long long)(((ox + 1) * shape[1] + oy + 1) * shape[2]))
        , current(start)
        , below(make_float4(0.0f, 0.0f, 0.0f, 0.0f))
        , middle(below)
        , above(below)
    {
    }
    CUDA_CALLABLE inline void take(const float4* q)
    {
        float w = wx(q[1].w, q[4].y) * wy(q[2].w, q[4].z), w0 = w * q[3].w, w2 = w * q[4].x, w1 = w - (w0 + w2), m = q[0].w;
        float x = q[0].x + q[1].x * fx + q[2].x * fy, y = q[0].y + q[1].y * fx + q[2].y * fy, z = q[0].z + q[1].z * fx + q[2].z * fy;
        float x0 = x - q[3].x, y0 = y - q[3].y, z0 = z - q[3].z, x2 = x + q[3].x, y2 = y + q[3].y, z2 = z + q[3].z;
        // In each branch, not behind them: sums that are carried and added to at once take no copies.
        auto gain = [&](const float4& b, const float4& c, const float4& a) {
            below = make_float4(b.x + w0 * x0, b.y + w0 * y0, b.z + w0 * z0, b.w + w0 * m);
            middle = make_float4(c.x + w1 * x, c.y + w1 * y, c.z + w1 * z, c.w + w1 * m);
            above = make_float4(a.x + w2 * x2, a.y + w2 * y2, a.z + w2 * z2, a.w + w2 * m);
        };
        const float4 zero = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        int next = first(q);
        if (next == current) {
            gain(below, middle, above);
        } else {
            auto at = cell(origin, current);
            add(at, below.x, below.y, below.z, below.w);
            if (next == current + 1) {
                gain(middle, above, zero);
            } else {
                add(at + 4, middle.x, middle.y, middle.z, middle.w);
                add(at + 8, above.x, above.y, above.z, above.w);
                gain(zero, zero, zero);
            }
            current = next;
        }
    }
    CUDA_CALLABLE inline void send()
    {
        auto at = cell(origin, current);
        add(at, below.x, below.y, below.z, below.w);
        add(at + 4, middle.x, middle.y, middle.z, middle.w);
        add(at + 8, above.x, above.y, above.z, above.w);
    }
};

// Two dimensions: one node, which is (x, y, m, 0).
template <class Sink> struct Owner<2, Sink> {
    static constexpr int WIDTH = 3;  // float4 per particle: 48 bytes, likewise free of conflicts when sorted
    Weight wx, wy;
    float fx, fy;
    Sink origin;
    int current;
    float x, y, mass;

    CUDA_CALLABLE static inline void write(
        float4* q, int first, const wp::vec_t<2, float>& g, const wp::vec_t<2, float>& b, const wp::mat_t<2, 2, float>& A, float m)
    {
        q[0] = make_float4(b[0], b[1], m, __int_as_float(first));
        q[1] = make_float4(A.data[0][0], A.data[1][0], A.data[0][1], A.data[1][1]);
        q[2] = make_float4(g[0], g[1], square(g[0]), square(g[1]));
    }
    CUDA_CALLABLE static inline int first(const float4* q) { return __float_as_int(q[0].w); }

    CUDA_CALLABLE inline Owner(Sink node, const wp::vec_t<2, int>& shape, int ox, int oy, int start)
        : wx(ox)
        , wy(oy)
        , fx(float(ox))
        , fy(float(oy))
        , origin(node + 4 * (long long)((ox + 1) * shape[1] + oy + 1))
        , current(start)
        , x(0.0f)
        , y(0.0f)
        , mass(0.0f)
    {
    }
    CUDA_CALLABLE inline void take(const float4* q)
    {
        int next = first(q);
        if (next != current) {
            send();
            x = y = mass = 0.0f;
            current = next;
        }
        float w = wx(q[2].x, q[2].z) * wy(q[2].y, q[2].w);
        x += w * (q[0].x + q[1].x * fx + q[1].z * fy);
        y += w * (q[0].y + q[1].y * fx + q[1].w * fy);
        mass += w * q[0].z;
    }
    CUDA_CALLABLE inline void send() { add(cell(origin, current), x, y, mass, 0.0f); }
};

template <unsigned DIM, class Sink>
CUDA_CALLABLE inline void add_warp(
    Sink node, const wp::vec_t<DIM, int>& shape, int first, const wp::vec_t<DIM, float>& g,
    const wp::vec_t<DIM, float>& b, const wp::mat_t<DIM, DIM, float>& A, float m)
{
    using Lane = Owner<DIM, Sink>;
    constexpr int WIDTH = Lane::WIDTH;
    __shared__ float4 box[(WP_TILE_BLOCK_DIM + 2) * WIDTH];  // the walk reads up to two particles behind the last
    int lane = threadIdx.x & (LANES - 1);
    float4* particles = box + (threadIdx.x - lane) * WIDTH;
    Lane::write(particles + sorted_place(first) * WIDTH, first, g, b, A, m);
    int count = __popc(__ballot_sync(0xffffffffu, first >= 0));
    int group = lane / 9, own = lane % 9, share = (count + 2) / 3;
    int begin = group * share, end = min(begin + share, count);
    if (group == 3)
        begin = end = 0;  // lanes 27 to 31 own nothing
    __syncwarp();

    // Each particle is read before it is waited for, which with few particles is where the time goes; into two places in turn, so that
    // none is copied.
    float4 one[WIDTH], other[WIDTH];
    auto read = [particles](float4* into, int p) {
        for (int k = 0; k < WIDTH; ++k)
            into[k] = particles[p * WIDTH + k];
    };
    read(one, begin);
    Lane owner(node, shape, own / 3 - 1, own % 3 - 1, Lane::first(one));
    for (int p = begin; p < end; p += 2) {
        read(other, p + 1);
        owner.take(one);
        read(one, p + 2);
        if (p + 1 < end)
            owner.take(other);
    }
    if (begin < end)
        owner.send();
    __syncwarp();
}

#else

template <typename T> using Four __attribute__((ext_vector_type(4))) = T;
template <typename T> inline Four<T> load(const T* p)
{
    Four<T> value;
    __builtin_memcpy(&value, p, sizeof(value));
    return value;
}
template <typename T> inline Four<T> load_constant(const T* p) { return load(p); }
template <typename T> inline void add(T* p, Four<T> term)
{
    term += load(p);
    __builtin_memcpy(p, &term, sizeof(term));
}

#endif

template <class Sink, typename T> CUDA_CALLABLE inline void add(Sink at, Four<T> term) { add(at, term.x, term.y, term.z, term.w); }

// (A1) node by node: on the CPU, and in double precision. Of the three planes of nodes along the first axis those from ``begin`` to ``end``.
// The weights are multiplied first: where b + A o was multiplied by one after the other, a turning body gained more spin by rounding.
template <class Sink, typename T>
CUDA_CALLABLE inline void add_each(
    Sink node, const wp::vec_t<3, int>& shape, int first, const wp::vec_t<3, T>& g, const wp::vec_t<3, T>& b,
    const wp::mat_t<3, 3, T>& A, T m, int begin = 0, int end = 3)
{
    if (first < 0)
        return;
    T w[3][3];
    for (int a = 0; a < 3; ++a)
        weights(g[a], w[a]);
    Four<T> middle = { b[0], b[1], b[2], m }, along[3];
    for (int a = 0; a < 3; ++a)
        along[a] = { A.data[0][a], A.data[1][a], A.data[2][a], T(0) };
    for (int i = begin; i < end; ++i)
        for (int j = 0; j < 3; ++j) {
            T wij = w[0][i] * w[1][j];
            Four<T> row = middle + along[0] * T(i - 1) + along[1] * T(j - 1);
            auto at = cell(node, first + (i * shape[1] + j) * shape[2]);
            add(at, (row - along[2]) * (wij * w[2][0]));
            add(at + 4, row * (wij * w[2][1]));
            add(at + 8, (row + along[2]) * (wij * w[2][2]));
        }
}

template <class Sink, typename T>
CUDA_CALLABLE inline void add_each(
    Sink node, const wp::vec_t<2, int>& shape, int first, const wp::vec_t<2, T>& g, const wp::vec_t<2, T>& b,
    const wp::mat_t<2, 2, T>& A, T m, int begin = 0, int end = 3)
{
    if (first < 0)
        return;
    T w[2][3];
    for (int a = 0; a < 2; ++a)
        weights(g[a], w[a]);
    Four<T> middle = { b[0], b[1], m, T(0) }, along[2];
    for (int a = 0; a < 2; ++a)
        along[a] = { A.data[0][a], A.data[1][a], T(0), T(0) };
    for (int i = begin; i < end; ++i) {
        Four<T> row = middle + along[0] * T(i - 1);
        auto at = cell(node, first + i * shape[1]);
        add(at, (row - along[1]) * (w[0][i] * w[1][0]));
        add(at + 4, row * (w[0][i] * w[1][1]));
        add(at + 8, (row + along[1]) * (w[0][i] * w[1][2]));
    }
}

// The whole warp must come here together; lanes without a particle have first = -1 and come after all others.
template <unsigned DIM, typename T>
CUDA_CALLABLE inline void scatter(
    wp::vec_t<4, T>* node, const wp::vec_t<DIM, int>& shape, int first, const wp::vec_t<DIM, T>& g,
    const wp::vec_t<DIM, T>& b, const wp::mat_t<DIM, DIM, T>& A, T m)
{
#if defined(__CUDA_ARCH__)
    if constexpr (sizeof(T) == 4) {
        add_warp(reinterpret_cast<T*>(node), shape, first, g, b, A, m);
        return;
    }
#endif
    add_each(reinterpret_cast<T*>(node), shape, first, g, b, A, m);
}

template <typename T> CUDA_CALLABLE inline wp::vec_t<4, T> load_node(const wp::vec_t<4, T>* node, int i)
{
    Four<T> n = load(reinterpret_cast<const T*>(node + i));
    return wp::vec_t<4, T>(n.x, n.y, n.z, n.w);
}

// The same as read-only memory: of an array that nothing writes while the kernel runs.
template <typename T> CUDA_CALLABLE inline wp::vec_t<4, T> load_constant_node(const wp::vec_t<4, T>* node, int i)
{
    Four<T> n = load_constant(reinterpret_cast<const T*>(node + i));
    return wp::vec_t<4, T>(n.x, n.y, n.z, n.w);
}

template <typename T> CUDA_CALLABLE inline void store_node(wp::vec_t<4, T>* node, int i, const wp::vec_t<4, T>& v)
{
    T* p = reinterpret_cast<T*>(node + i);
#if defined(__CUDA_ARCH__)
    if constexpr (sizeof(T) == 4) {
        *reinterpret_cast<float4*>(p) = make_float4(v[0], v[1], v[2], v[3]);
        return;
    }
#endif
    for (int a = 0; a < 4; ++a)
        p[a] = v[a];
}

// Packed particles: blocks of 32, in each block one row of 32 numbers after the other. Particle i, row r. A model of the fast scheme
// has no more particles than 32-bit indices reach.
template <int ROWS, typename T> CUDA_CALLABLE inline T* packed(T* rows, int i, int r)
{
    return rows + (unsigned(i) / LANES * (ROWS * LANES) + unsigned(i) % LANES + r * LANES);
}

// A load past the nearest cache, which might hold an older copy, see kernels/dependent.py.
template <typename T> CUDA_CALLABLE inline T recent(const T* p)
{
#if defined(__CUDA_ARCH__)
    return __ldcg(p);
#else
    return *p;
#endif
}

// Early loads, before the wait for the previous kernel, go past the nearest cache.
template <bool EARLY, int ROWS, int COUNT, typename T> CUDA_CALLABLE inline void load_rows(const T* rows, int i, int r, T* out)
{
    const T* at = packed<ROWS>(rows, i, r);
    for (int k = 0; k < COUNT; ++k)
        out[k] = EARLY ? recent(at + k * LANES) : at[k * LANES];
}

template <int ROWS, int COUNT, typename T> CUDA_CALLABLE inline void store_rows(T* rows, int i, int r, const T* in)
{
    T* at = packed<ROWS>(rows, i, r);
    for (int k = 0; k < COUNT; ++k)
        at[k * LANES] = in[k];
}

// Write the COUNT numbers of each lane's particle to its row of an array in the user's order. The lanes of a warp write a row together:
// alone, a lane would touch a row COUNT times, one number at a time. Threads stand in a line, this one is number i of ``total``; all of
// a warp come here together.
template <int COUNT, typename T> CUDA_CALLABLE inline void spread(T* out, int row, const T* value, int i, int total)
{
#if defined(__CUDA_ARCH__)
    __shared__ T box[WP_TILE_BLOCK_DIM * COUNT];
    int lane = threadIdx.x & (LANES - 1), lanes = min(LANES, total - (i - lane));
    unsigned together = 0xffffffffu >> (LANES - lanes);
    T* all = box + (threadIdx.x - lane) * COUNT;
    for (int k = 0; k < COUNT; ++k)
        all[lane * COUNT + k] = value[k];
    __syncwarp(together);
    for (int n = lane; n < lanes * COUNT; n += lanes) {
        int owner = n / COUNT;
        out[(long long)__shfl_sync(together, row, owner) * COUNT + n - owner * COUNT] = all[n];
    }
    __syncwarp(together);
#else
    for (int k = 0; k < COUNT; ++k)
        out[(long long)row * COUNT + k] = value[k];
#endif
}

// All rows of particle j to the place of particle i.
template <int ROWS, typename T> CUDA_CALLABLE inline void copy_rows(const T* source, int j, T* target, int i)
{
    const T* from = packed<ROWS>(source, j, 0);
    T *to = packed<ROWS>(target, i, 0), value[ROWS];
    for (int r = 0; r < ROWS; ++r)
        value[r] = from[r * LANES];
    for (int r = 0; r < ROWS; ++r)
        to[r * LANES] = value[r];
}

}  // namespace softmpm
