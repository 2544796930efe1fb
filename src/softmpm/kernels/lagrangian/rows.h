// Rows of arrays, and sums over the entries of lists.
namespace softmpm {

// The numbers along the last axis, which lie next to each other, at given places of the other axes. An entry of a row is found by one
// product of 32 bits, that of an array with several axes by one of 64 bits for each of them, and Warp's arrays also count from the end.
template <typename T, typename... Places> CUDA_CALLABLE inline wp::array_t<T> row(const wp::array_t<T>& all, Places... places)
{
    char* data = reinterpret_cast<char*>(all.data);
    const int* stride = all.strides;
    ((data += size_t(places) * size_t(*stride++)), ...);
#if defined(__CUDA_ARCH__)
    size_t address = __cvta_generic_to_global(data);
    asm("" : "+l"(address));  // else the compiler adds its parts to each entry anew
    data = static_cast<char*>(__cvta_global_to_generic(address));
#endif
    wp::array_t<T> one;
    one.data = reinterpret_cast<T*>(data);
    one.ndim = 1;
    one.strides[0] = sizeof(T);
#if !defined(NDEBUG)
    one.shape.dims[0] = all.shape.dims[sizeof...(places)];  // else zero: the compiler drops the count from the end
#endif
    return one;
}

#if !defined(__CUDA_ARCH__)
// Sum of share times value over the entries from first to last of a list, with four numbers at a time; even and odd ones, so that an
// addition need not wait for the one before.
template <typename T, unsigned DIM>
inline wp::vec_t<DIM, T> sum_of_entries(
    const wp::array_t<int>& members, const wp::array_t<T>& shares, int first, int last, const wp::array_t<wp::vec_t<DIM, T>>& values)
{
#pragma clang fp contract(fast)
    using Four __attribute__((ext_vector_type(4))) = T;
    const int* member = members.data;
    const T* share = shares.data;
    const auto value = [&](int m) {
        const T* a = values.data[member[m]].c;
        return Four { a[0], a[1], DIM == 2 ? T(0) : a[DIM - 1], T(0) };
    };
    Four even = {}, odd = {};
    int m = first;
    for (; m + 1 < last; m += 2) {
        even += share[m] * value(m);
        odd += share[m + 1] * value(m + 1);
    }
    if (m < last)
        even += share[m] * value(m);
    even += odd;
    wp::vec_t<DIM, T> total;
    for (unsigned axis = 0; axis < DIM; ++axis)
        total.c[axis] = even[axis];
    return total;
}
#endif
}  // namespace softmpm
