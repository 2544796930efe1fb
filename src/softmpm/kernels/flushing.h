// Denormal numbers, below 1.2e-38 in float32, are zero in this thread while an object of this class lives: in simulations of free bodies
// they are frequent, and some x86 processors compute slowly with them (docs/performance.md).
namespace softmpm {
class Flushing {
#if defined(__SSE__)
    static constexpr unsigned ZERO = 0x8040;  // denormal inputs and results
    const unsigned before = __builtin_ia32_stmxcsr();

public:
    Flushing() { __builtin_ia32_ldmxcsr(before | ZERO); }
    ~Flushing() { __builtin_ia32_ldmxcsr(before); }
#endif
};
}  // namespace softmpm
