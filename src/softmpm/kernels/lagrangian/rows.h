// Rows of arrays.
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
}  // namespace softmpm
