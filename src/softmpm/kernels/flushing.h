// Numbers below 1.2e-38 (float32) are zero while an object of this class lives, in this thread. Bodies that fly freely or hardly deform
// are full of them, and on many x86 processors an operation with one takes a hundred times longer.
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
