// Particles and layers of a lattice on the CPU, with four numbers at a time; formulas as in interpolation.py and bricks.h.
namespace softmpm {

template <typename T> using Four __attribute__((ext_vector_type(4))) = T;

template <typename T> using Two __attribute__((ext_vector_type(2))) = T;

// Both components of a node at once, and no others: the next particle loads them again from where they were stored.
template <typename T> inline void add_to(wp::vec_t<2, T>& node, Four<T> term)
{
    Two<T> sum;
    __builtin_memcpy(&sum, node.c, sizeof(sum));
    sum += term.lo + term.hi;
    __builtin_memcpy(node.c, &sum, sizeof(sum));
}

// In 2D the four are both components with the weights w along an axis, then both with the weights e.
template <typename T> inline Four<T> pairs(T first, T second) { return Four<T> { first, first, second, second }; }

template <int NODES, int ACROSS, int ALONG, int K, typename T>
inline wp::mat_t<K * 2, 2, T> cpu_gradients(
    const wp::array_t<wp::vec_t<2, T>>& values, const wp::array_t<int>& window, int world, int brick, int corner, int layer,
    const wp::mat_t<K * 2, 3, T>& w, const wp::mat_t<K * 2, 3, T>& e)
{
#pragma clang fp contract(fast)
    const wp::vec_t<2, T>* first = values.data + size_t(world) * values.shape[1];
    const int* node = window.data + brick * NODES + corner;
    const T *wl = w.data[K + layer], *el = e.data[K + layer];
    Four<T> sums[K] = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a = {};
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            const T* n = first[node[i * ALONG + k]].c;
            a += pairs(wl[k], el[k]) * Four<T> { n[0], n[1], n[0], n[1] };
        }
#pragma unroll
        for (int r = 0; r < K; ++r)
            sums[r] += pairs(e.data[r][i], w.data[r][i]) * a;
    }
    wp::mat_t<K * 2, 2, T> out;
#pragma unroll
    for (int r = 0; r < K; ++r)
        for (int c = 0; c < 2; ++c)
            for (int axis = 0; axis < 2; ++axis)
                out.data[2 * r + c][axis] = sums[r][2 * axis + c];
    return out;
}

template <int NODES, int ACROSS, int ALONG, int K, typename T>
inline void cpu_add(
    const wp::mat_t<K * 2, 2, T>& A, const wp::array_t<wp::vec_t<2, T>>& partial, int world, int brick, int corner, int layer,
    const wp::mat_t<K * 2, 3, T>& w, const wp::mat_t<K * 2, 3, T>& e)
{
#pragma clang fp contract(fast)
    wp::vec_t<2, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES + corner;
    const T *wl = w.data[K + layer], *el = e.data[K + layer];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a = {};
#pragma unroll
        for (int r = 0; r < K; ++r) {
            const T *x = A.data[2 * r], *y = A.data[2 * r + 1];
            a += pairs(e.data[r][i], w.data[r][i]) * Four<T> { x[0], y[0], x[1], y[1] };
        }
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            add_to(out[i * ALONG + k], pairs(wl[k], el[k]) * a);
        }
    }
}

// One particle, with the weights of node o along each axis in row o: Σ a (x) g / rate.
template <int NODES, int ACROSS, int ALONG, typename T>
inline wp::mat_t<2, 2, T> cpu_gradient(
    const wp::array_t<wp::vec_t<2, T>>& values, const wp::array_t<int>& window, int world, int brick, int corner,
    const wp::mat_t<3, 2, T>& w, const wp::mat_t<3, 2, T>& e)
{
#pragma clang fp contract(fast)
    const wp::vec_t<2, T>* first = values.data + size_t(world) * values.shape[1];
    const int* node = window.data + brick * NODES + corner;
    Four<T> sum = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a = {};
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            const T* n = first[node[i * ALONG + k]].c;
            a += pairs(w.data[k][1], e.data[k][1]) * Four<T> { n[0], n[1], n[0], n[1] };
        }
        sum += pairs(e.data[i][0], w.data[i][0]) * a;
    }
    wp::mat_t<2, 2, T> out;
    for (int c = 0; c < 2; ++c)
        for (int axis = 0; axis < 2; ++axis)
            out.data[c][axis] = sum[2 * axis + c];
    return out;
}

// Add N b + A g / rate of one particle.
template <int NODES, int ACROSS, int ALONG, typename T>
inline void cpu_add_one(
    const wp::mat_t<2, 2, T>& A, const wp::vec_t<2, T>& b, const wp::array_t<wp::vec_t<2, T>>& partial, int world, int brick,
    int corner, const wp::mat_t<3, 2, T>& w, const wp::mat_t<3, 2, T>& e)
{
#pragma clang fp contract(fast)
    wp::vec_t<2, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES + corner;
    const Four<T> columns = { A.data[0][0], A.data[1][0], A.data[0][1], A.data[1][1] };
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const T wi = w.data[i][0];
        const Four<T> a = pairs(e.data[i][0], wi) * columns + Four<T> { wi * b.c[0], wi * b.c[1], T(0), T(0) };
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            add_to(out[i * ALONG + k], pairs(w.data[k][1], e.data[k][1]) * a);
        }
    }
}

// In 3D the four are the components.
template <int NODES, int ACROSS, int ALONG, int K, typename T>
inline wp::mat_t<K * K * 3, 3, T> cpu_gradients(
    const wp::array_t<wp::vec_t<3, T>>& values, const wp::array_t<int>& window, int world, int brick, int corner, int layer,
    const wp::mat_t<K * 3, 3, T>& w, const wp::mat_t<K * 3, 3, T>& e)
{
#pragma clang fp contract(fast)
    const wp::vec_t<3, T>* first = values.data + size_t(world) * values.shape[1];
    const int* node = window.data + brick * NODES + corner;
    const T *wl = w.data[2 * K + layer], *el = e.data[2 * K + layer];
    Four<T> sums[K][K][3] = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a[K][3] = {};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            Four<T> s = {}, d = {};
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                const T* n = first[node[(i * ACROSS + j) * ALONG + k]].c;
                const Four<T> value = { n[0], n[1], n[2], T(0) };
                s += wl[k] * value;
                d += el[k] * value;
            }
#pragma unroll
            for (int q = 0; q < K; ++q) {
                a[q][0] += w.data[K + q][j] * s;
                a[q][1] += e.data[K + q][j] * s;
                a[q][2] += w.data[K + q][j] * d;
            }
        }
#pragma unroll
        for (int r = 0; r < K; ++r)
#pragma unroll
            for (int q = 0; q < K; ++q)
#pragma unroll
                for (int axis = 0; axis < 3; ++axis)
                    sums[r][q][axis] += (axis == 0 ? e : w).data[r][i] * a[q][axis];
    }
    wp::mat_t<K * K * 3, 3, T> out;
#pragma unroll
    for (int n = 0; n < K * K; ++n)
        for (int c = 0; c < 3; ++c)
            for (int axis = 0; axis < 3; ++axis)
                out.data[3 * n + c][axis] = sums[n / K][n % K][axis][c];
    return out;
}

template <int NODES, int ACROSS, int ALONG, int K, typename T>
inline void cpu_add(
    const wp::mat_t<K * K * 3, 3, T>& A, const wp::array_t<wp::vec_t<3, T>>& partial, int world, int brick, int corner, int layer,
    const wp::mat_t<K * 3, 3, T>& w, const wp::mat_t<K * 3, 3, T>& e)
{
#pragma clang fp contract(fast)
    wp::vec_t<3, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES + corner;
    const T *wl = w.data[2 * K + layer], *el = e.data[2 * K + layer];
    Four<T> columns[K][K][3];
#pragma unroll
    for (int n = 0; n < K * K; ++n)
        for (int axis = 0; axis < 3; ++axis) {
            const auto* rows = &A.data[3 * n];
            columns[n / K][n % K][axis] = Four<T> { rows[0][axis], rows[1][axis], rows[2][axis], T(0) };
        }
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a[K][3] = {};
#pragma unroll
        for (int q = 0; q < K; ++q)
#pragma unroll
            for (int r = 0; r < K; ++r)
#pragma unroll
                for (int axis = 0; axis < 3; ++axis)
                    a[q][axis] += (axis == 0 ? e : w).data[r][i] * columns[r][q][axis];
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            Four<T> plain = {}, sloped = {};
#pragma unroll
            for (int q = 0; q < K; ++q) {
                plain += w.data[K + q][j] * a[q][0] + e.data[K + q][j] * a[q][1];
                sloped += w.data[K + q][j] * a[q][2];
            }
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                const Four<T> b = wl[k] * plain + el[k] * sloped;
                T* node = out[(i * ACROSS + j) * ALONG + k].c;
                for (int c = 0; c < 3; ++c)
                    node[c] += b[c];
            }
        }
    }
}

template <int NODES, int ACROSS, int ALONG, typename T>
inline wp::mat_t<3, 3, T> cpu_gradient(
    const wp::array_t<wp::vec_t<3, T>>& values, const wp::array_t<int>& window, int world, int brick, int corner,
    const wp::mat_t<3, 3, T>& w, const wp::mat_t<3, 3, T>& e)
{
#pragma clang fp contract(fast)
    const wp::vec_t<3, T>* first = values.data + size_t(world) * values.shape[1];
    const int* node = window.data + brick * NODES + corner;
    Four<T> sums[3] = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        Four<T> a[3] = {};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            Four<T> s = {}, d = {};
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                const T* n = first[node[(i * ACROSS + j) * ALONG + k]].c;
                const Four<T> value = { n[0], n[1], n[2], T(0) };
                s += w.data[k][2] * value;
                d += e.data[k][2] * value;
            }
            a[0] += w.data[j][1] * s;
            a[1] += e.data[j][1] * s;
            a[2] += w.data[j][1] * d;
        }
        sums[0] += e.data[i][0] * a[0];
        sums[1] += w.data[i][0] * a[1];
        sums[2] += w.data[i][0] * a[2];
    }
    wp::mat_t<3, 3, T> out;
    for (int c = 0; c < 3; ++c)
        for (int axis = 0; axis < 3; ++axis)
            out.data[c][axis] = sums[axis][c];
    return out;
}

template <int NODES, int ACROSS, int ALONG, typename T>
inline void cpu_add_one(
    const wp::mat_t<3, 3, T>& A, const wp::vec_t<3, T>& b, const wp::array_t<wp::vec_t<3, T>>& partial, int world, int brick,
    int corner, const wp::mat_t<3, 3, T>& w, const wp::mat_t<3, 3, T>& e)
{
#pragma clang fp contract(fast)
    wp::vec_t<3, T>* out = partial.data + size_t(world) * partial.shape[1] + brick * NODES + corner;
    Four<T> columns[3];
    for (int axis = 0; axis < 3; ++axis)
        columns[axis] = Four<T> { A.data[0][axis], A.data[1][axis], A.data[2][axis], T(0) };
    const Four<T> load = { b.c[0], b.c[1], b.c[2], T(0) };
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const Four<T> x = e.data[i][0] * columns[0] + w.data[i][0] * load;
        const Four<T> y = w.data[i][0] * columns[1], z = w.data[i][0] * columns[2];
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const Four<T> plain = w.data[j][1] * x + e.data[j][1] * y, sloped = w.data[j][1] * z;
#pragma unroll
            for (int k = 0; k < 3; ++k) {
                const Four<T> term = w.data[k][2] * plain + e.data[k][2] * sloped;
                T* node = out[(i * ACROSS + j) * ALONG + k].c;
                for (int c = 0; c < 3; ++c)
                    node[c] += term[c];
            }
        }
    }
}
}  // namespace softmpm
