// Memory of a brick of cells: nodal fields of its window, what the particles of a row give, and the sums for the nodes of the window. On a
// GPU a block of threads shares all of it; on the CPU one thread has a brick, reads nodes where they are and adds to the partial sums.
// No two threads add to one number, and the order of the terms is always the same.
namespace softmpm {

template <typename T, unsigned DIM> struct alignas(DIM == 2 ? 2 * sizeof(T) : 16) Node {
    T at[DIM == 2 ? 2 : 4];  // three numbers and one that is not used are read at once
};

#if defined(__CUDA_ARCH__)
// Groups of a block that have a brick each, and that of this thread.
#if !defined(SOFTMPM_GROUPS)
#define SOFTMPM_GROUPS 1
#endif
constexpr int GROUPS = SOFTMPM_GROUPS;
CUDA_CALLABLE inline int group() { return GROUPS == 1 ? 0 : threadIdx.x / (blockDim.x / GROUPS); }

template <int FIELD, int NODES, typename T, unsigned DIM> CUDA_CALLABLE inline Node<T, DIM>* shared_nodes()
{
    __shared__ Node<T, DIM> nodes[GROUPS * NODES];
    return nodes + group() * NODES;
}

template <int SIZE, typename T> CUDA_CALLABLE inline T* shared_terms()
{
    __shared__ T terms[GROUPS * SIZE];
    return terms + group() * SIZE;
}
#else  // never read: on the CPU bricks are serial
template <int, int, typename T, unsigned DIM> CUDA_CALLABLE inline Node<T, DIM>* shared_nodes() { return nullptr; }
template <int, typename T> CUDA_CALLABLE inline T* shared_terms() { return nullptr; }
#endif

// Number of this block of threads, and of this thread in it: found from the number of the thread, they would take divisions of 64 bits.
CUDA_CALLABLE inline int block_number()
{
#if defined(__CUDA_ARCH__)
    return blockIdx.x + gridDim.x * (blockIdx.y + gridDim.y * blockIdx.z);
#else
    return 0;
#endif
}

CUDA_CALLABLE inline int thread_number()
{
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
}

CUDA_CALLABLE inline void meet()
{
#if defined(__CUDA_ARCH__)
    if (GROUPS == 1)
        __syncthreads();
    else
        asm volatile("bar.sync %0, %1;" ::"r"(group() + 1), "r"(blockDim.x / GROUPS) : "memory");
#endif
}

// Wait for all threads of a cluster of blocks; they see what the others have written before. With ALIGNED the threads of a warp wait for
// each other first, and the compiler relies on it.
template <bool ALIGNED> CUDA_CALLABLE inline void meet_cluster()
{
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    if (ALIGNED) {
        __syncwarp();
        asm volatile("barrier.cluster.arrive.release.aligned;\n\tbarrier.cluster.wait.acquire.aligned;" ::: "memory");
    } else
        asm volatile("barrier.cluster.arrive.release;\n\tbarrier.cluster.wait.acquire;" ::: "memory");
#endif
}

// Wait for the threads of cells with the same first coordinate, of which a window has ACROSS x ALONG nodes: they are in one warp.
template <int ACROSS, int ALONG, unsigned DIM> CUDA_CALLABLE inline void meet_slice()
{
    static_assert(32 % (DIM == 2 ? ALONG - 2 : (ACROSS - 2) * (ALONG - 2)) == 0, "a slice of cells has to lie in one warp");
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
}

// Nodes of the window that a thread copies, or -1.
template <int NODES, int THREADS>
CUDA_CALLABLE inline wp::vec_t<(NODES + THREADS - 1) / THREADS, int> window_nodes(const wp::array_t<int>& window, int brick, int lane)
{
    constexpr int EACH = (NODES + THREADS - 1) / THREADS;
    const int* node = window.data + brick * NODES;
    wp::vec_t<EACH, int> at;
#pragma unroll
    for (int n = 0; n < EACH; ++n)
        at.c[n] = node[lane + n * THREADS < NODES ? lane + n * THREADS : 0];
    return at;
}

// Copy a nodal field of the window; complete after meet().
template <int FIELD, int NODES, int THREADS, unsigned EACH, typename T, unsigned DIM>
CUDA_CALLABLE inline void stage(
    const wp::array_t<wp::vec_t<DIM, T>>& values, const wp::vec_t<EACH, int>& at, int world, int lane)
{
    Node<T, DIM>* nodes = shared_nodes<FIELD, NODES, T, DIM>();
    const wp::vec_t<DIM, T>* first = values.data + size_t(world) * values.shape[1];
    wp::vec_t<DIM, T> value[EACH];
#pragma unroll
    for (int n = 0; n < int(EACH); ++n)
        value[n] = first[at.c[n] > 0 ? at.c[n] : 0];
#pragma unroll
    for (int n = 0; n < int(EACH); ++n)
        if (lane + n * THREADS < NODES) {
            Node<T, DIM> node = {};  // stored as a whole, as it is read
            for (unsigned axis = 0; axis < DIM; ++axis)
                node.at[axis] = at.c[n] >= 0 ? value[n].c[axis] : T(0);
            nodes[lane + n * THREADS] = node;
        }
}

// Node k of the window
template <int FIELD, int NODES, typename T, unsigned DIM>
CUDA_CALLABLE inline wp::vec_t<DIM, T> fetch(
    const wp::array_t<wp::vec_t<DIM, T>>& values, const wp::array_t<int>& window, int world, int brick, int k)
{
#if defined(__CUDA_ARCH__)
    Node<T, DIM> node = shared_nodes<FIELD, NODES, T, DIM>()[k];
    wp::vec_t<DIM, T> value;
    for (unsigned axis = 0; axis < DIM; ++axis)
        value.c[axis] = node.at[axis];
    return value;
#else
    return values.data[size_t(world) * values.shape[1] + window.data[brick * NODES + k]];
#endif
}

// Vectors of the particle of each thread; `number` counts them.
template <int SIZE, int THREADS, typename T, unsigned DIM>
CUDA_CALLABLE inline void give(int number, int lane, const wp::vec_t<DIM, T>& value)
{
    for (unsigned axis = 0; axis < DIM; ++axis)
        shared_terms<SIZE, T>()[(number * DIM + axis) * THREADS + lane] = value.c[axis];
}

template <int SIZE, int THREADS, typename T, unsigned DIM>
CUDA_CALLABLE inline wp::vec_t<DIM, T> given(int number, int lane)
{
    wp::vec_t<DIM, T> value;
    for (unsigned axis = 0; axis < DIM; ++axis)
        value.c[axis] = shared_terms<SIZE, T>()[(number * DIM + axis) * THREADS + lane];
    return value;
}

// Store a row of `COUNT` numbers of each thread; those with a negative number have none. All threads of a block come here together. The
// threads of a warp store row after row: rows lie in the user's order, and single numbers would take a memory transaction each.
template <int COUNT, int THREADS, typename T> CUDA_CALLABLE inline void scatter_rows(T* out, int row, int lane, const T* value)
{
#if defined(__CUDA_ARCH__)
    __shared__ T box[GROUPS * THREADS * COUNT];
    const int own = lane % 32, first = lane - own, lanes = THREADS - first < 32 ? THREADS - first : 32;
    const unsigned together = 0xffffffffu >> (32 - lanes);
    T* all = box + (group() * THREADS + first) * COUNT;
    for (int k = 0; k < COUNT; ++k)
        all[own * COUNT + k] = value[k];
    __syncwarp(together);
    for (int n = own; n < lanes * COUNT; n += lanes) {
        const int owner = n / COUNT, target = __shfl_sync(together, row, owner);
        if (target >= 0)
            out[size_t(target) * COUNT + n - owner * COUNT] = all[n];
    }
    __syncwarp(together);
#else
    if (row >= 0)
        for (int k = 0; k < COUNT; ++k)
            out[size_t(row) * COUNT + k] = value[k];
#endif
}

// Set the partial sums of a brick to zero, on the CPU.
template <int NODES, typename T, unsigned DIM>
CUDA_CALLABLE inline void clear_sums(const wp::array_t<wp::vec_t<DIM, T>>& partial, int world, int brick)
{
#if !defined(__CUDA_ARCH__)
    wp::vec_t<DIM, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES;
    for (int k = 0; k < NODES; ++k)
        out[k] = {};
#endif
}

// Write the sums that each thread has for one component of the COUNT nodes of a cell, of which `corner` is the first in the window, or -1.
// Components of FIELDS fields are counted on. Sums of each component are taken in three planes, one for each first offset of a node in its
// cell. Within a plane only cells with the same first coordinate share nodes, and these add one offset after the other.
template <int SIZE, int NODES, int THREADS, int COUNT, int ACROSS, int ALONG, int FIELDS, typename T, unsigned DIM>
CUDA_CALLABLE inline void write_sums(
    const wp::vec_t<COUNT, T>& total, const wp::array_t<wp::vec_t<DIM, T>>& first, const wp::array_t<wp::vec_t<DIM, T>>& second,
    int world, int brick, int corner, int axis, int lane)
{
    constexpr int TURNS = COUNT / 3, ALL = NODES * int(DIM);
    static_assert(3 * ALL * FIELDS <= SIZE);
    T* sums = shared_terms<SIZE, T>();  // in place of what the particles gave
    for (int k = lane; k < 3 * ALL * FIELDS; k += THREADS)
        sums[k] = T(0);
    meet();
#pragma unroll
    for (int turn = 0; turn < TURNS; ++turn) {
        if (corner >= 0)
#pragma unroll
            for (int i = 0; i < 3; ++i) {
                int node = corner + (DIM == 2 ? i * ALONG + turn : (i * ACROSS + turn / 3) * ALONG + turn % 3);
                sums[(axis * 3 + i) * NODES + node] += total.c[i * TURNS + turn];
            }
        meet_slice<ACROSS, ALONG, DIM>();
    }
    meet();
    const size_t place = size_t(world) * first.shape[1] + brick * NODES;
    for (int n = lane; n < ALL * FIELDS; n += THREADS) {
        const int field = n / ALL, k = n - field * ALL;
        const T* own = sums + (field * int(DIM) + k % DIM) * 3 * NODES + k / DIM;
        reinterpret_cast<T*>((field == 0 ? first : second).data + place)[k] = own[0] + own[NODES] + own[2 * NODES];
    }
    meet();  // the sums may be used again
}

// Lattices: the particles of every cell have the same K places along each axis. A thread has those of a cell with one place along the
// last axis; w and e are the weights w and 4/dx w (o - f) of node o, [axis][place][o] in rows of three.

// The three weights of a layer, of K rows from `FIRST` on. A row chosen by its number would put the table into local memory.
template <int FIRST, int K, typename T, unsigned ROWS>
CUDA_CALLABLE inline void layer_weights(const wp::mat_t<ROWS, 3, T>& table, int layer, T* out)
{
#pragma unroll
    for (int o = 0; o < 3; ++o) {
        out[o] = table.data[FIRST][o];
#pragma unroll
        for (int k = 1; k < K; ++k)
            out[o] = layer == k ? table.data[FIRST + k][o] : out[o];
    }
}

// Sums a (x) g over the nodes of a cell, for the K^(DIM - 1) particles of a layer, DIM rows for each.
template <int FIELD, int NODES, int ACROSS, int ALONG, int K, typename T, unsigned DIM>
CUDA_CALLABLE inline wp::mat_t<(DIM == 2 ? K : K * K) * DIM, DIM, T> layer_gradients(
    const wp::array_t<wp::vec_t<DIM, T>>& values, const wp::array_t<int>& window, int world, int brick, int corner, int layer,
    const wp::mat_t<K * DIM, 3, T>& w, const wp::mat_t<K * DIM, 3, T>& e)
{
#if !defined(__CUDA_ARCH__)
    return cpu_gradients<NODES, ACROSS, ALONG, K>(values, window, world, brick, corner, layer, w, e);
#else
    constexpr int LAST = (DIM - 1) * K, Q = DIM == 2 ? 1 : K;  // places along the middle axis
    wp::mat_t<(DIM == 2 ? K : K * K) * DIM, DIM, T> out(T(0));
    T wl[3], el[3];
    layer_weights<LAST, K>(w, layer, wl);
    layer_weights<LAST, K>(e, layer, el);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        T a[Q][DIM][DIM] = {};  // with the slope along the first axis to come, along the middle one and the last
#pragma unroll
        for (int j = 0; j < (DIM == 2 ? 1 : 3); ++j) {
            T s[DIM] = {}, d[DIM] = {};
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                wp::vec_t<DIM, T> n = fetch<FIELD, NODES, T, DIM>(
                    values, window, world, brick, corner + (DIM == 2 ? i : i * ACROSS + j) * ALONG + k);
#pragma unroll
                for (unsigned c = 0; c < DIM; ++c) {
                    s[c] += wl[k] * n.c[c];
                    d[c] += el[k] * n.c[c];
                }
            }
#pragma unroll
            for (int q = 0; q < Q; ++q)
#pragma unroll
                for (unsigned c = 0; c < DIM; ++c)
                    if constexpr (DIM == 2) {
                        a[q][0][c] = s[c];
                        a[q][1][c] = d[c];
                    } else {
                        a[q][0][c] += w.data[K + q][j] * s[c];
                        a[q][1][c] += e.data[K + q][j] * s[c];
                        a[q][2][c] += w.data[K + q][j] * d[c];
                    }
        }
#pragma unroll
        for (int r = 0; r < K; ++r)
#pragma unroll
            for (int q = 0; q < Q; ++q)
#pragma unroll
                for (unsigned c = 0; c < DIM; ++c) {
                    T* h = out.data[(r * Q + q) * DIM + c];
                    h[0] += e.data[r][i] * a[q][0][c];
                    for (unsigned axis = 1; axis < DIM; ++axis)
                        h[axis] += w.data[r][i] * a[q][axis][c];
                }
    }
    return out;
#endif
}

// Add A g of the particles of a layer to the sums of the brick. All threads of a block come here together, those without a cell
// with a negative corner. Each layer has planes of its own, for every first offset.
template <int NODES, int CELLS, int ACROSS, int ALONG, int K, typename T, unsigned DIM>
CUDA_CALLABLE inline void add_layer(
    const wp::mat_t<(DIM == 2 ? K : K * K) * DIM, DIM, T>& A, const wp::array_t<wp::vec_t<DIM, T>>& partial, int world, int brick,
    int corner, int layer, int lane, const wp::mat_t<K * DIM, 3, T>& w, const wp::mat_t<K * DIM, 3, T>& e)
{
#if !defined(__CUDA_ARCH__)
    if (corner >= 0)
        cpu_add<NODES, ACROSS, ALONG, K>(A, partial, world, brick, corner, layer, w, e);
#else
    constexpr int LAST = (DIM - 1) * K, Q = DIM == 2 ? 1 : K, MIDDLE = DIM == 2 ? 1 : 3;
    wp::vec_t<DIM, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES;
    constexpr int THREADS = CELLS * K;
    Node<T, DIM>* planes = shared_nodes<-1, 3 * K * NODES, T, DIM>();
    meet();  // sums that were added before may still be read
    for (int k = lane; k < 3 * K * NODES; k += THREADS)
        planes[k] = {};
    meet();
    T x[3][Q][DIM], y[3][Q][DIM], z[3][Q][DIM];
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int q = 0; q < Q; ++q)
#pragma unroll
            for (unsigned c = 0; c < DIM; ++c) {
                T sums[3] = {};
#pragma unroll
                for (int r = 0; r < K; ++r) {
                    const T* h = A.data[(r * Q + q) * DIM + c];
                    sums[0] += e.data[r][i] * h[0];
                    for (unsigned axis = 1; axis < DIM; ++axis)
                        sums[axis] += w.data[r][i] * h[axis];
                }
                x[i][q][c] = sums[0], y[i][q][c] = sums[1], z[i][q][c] = sums[2];
            }
    T of_layer[3], sloped_layer[3];
    layer_weights<LAST, K>(w, layer, of_layer);
    layer_weights<LAST, K>(e, layer, sloped_layer);
#pragma unroll
    for (int j = 0; j < MIDDLE; ++j) {
        T plain[3][DIM], sloped[3][DIM];
#pragma unroll
        for (int i = 0; i < 3; ++i)
#pragma unroll
            for (unsigned c = 0; c < DIM; ++c) {
                if constexpr (DIM == 2) {
                    plain[i][c] = x[i][0][c], sloped[i][c] = y[i][0][c];
                } else {
                    T p = T(0), s = T(0);
#pragma unroll
                    for (int q = 0; q < Q; ++q) {
                        p += w.data[K + q][j] * x[i][q][c];
                        p += e.data[K + q][j] * y[i][q][c];
                        s += w.data[K + q][j] * z[i][q][c];
                    }
                    plain[i][c] = p, sloped[i][c] = s;
                }
            }
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            T wl = of_layer[k], el = sloped_layer[k];
            if (corner >= 0)
#pragma unroll
                for (int i = 0; i < 3; ++i) {
                    Node<T, DIM>* node = planes + (layer * 3 + i) * NODES + corner + (DIM == 2 ? i : i * ACROSS + j) * ALONG + k;
                    Node<T, DIM> sum = *node;
                    for (unsigned c = 0; c < DIM; ++c) {
                        sum.at[c] += wl * plain[i][c];
                        sum.at[c] += el * sloped[i][c];
                    }
                    *node = sum;
                }
            meet_slice<ACROSS, ALONG, DIM>();
        }
    }
    meet();
    for (int k = lane; k < NODES; k += THREADS) {
        wp::vec_t<DIM, T> sum = {};
#pragma unroll
        for (int plane = 0; plane < 3 * K; ++plane) {
            Node<T, DIM> node = planes[plane * NODES + k];
            for (unsigned c = 0; c < DIM; ++c)
                sum.c[c] += node.at[c];
        }
        out[k] = sum;
    }
#endif
}
}  // namespace softmpm
