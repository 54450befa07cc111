// Waits until all threads of a team are here.
//
// warp has no barrier between threads of a CPU, since it has no such threads. The last to arrive opens the next round,
// which the others wait for; counter and round lie in cache lines of their own. A thread that has waited in vain for
// long, since there are more threads than processors, lets others run. A kernel's text cannot include headers: the
// function that does so is declared by its name in the libraries of the system.
#if defined(_WIN32)
    #define GEOKIT_YIELD "SwitchToThread"
#elif defined(__APPLE__)
    #define GEOKIT_YIELD "_sched_yield"
#else
    #define GEOKIT_YIELD "sched_yield"
#endif
static constexpr auto barrier = [](const Share& share) {
    if (share.threads > 1) {
        extern int geokit_yield() __asm__(GEOKIT_YIELD);
        int* const arrived = share.meeting.data;
        int* const round = share.meeting.data + 32;
        const int now = __atomic_load_n(round, __ATOMIC_RELAXED);
        if (__atomic_add_fetch(arrived, 1, __ATOMIC_ACQ_REL) == share.threads) {
            __atomic_store_n(arrived, 0, __ATOMIC_RELAXED);
            __atomic_store_n(round, now + 1, __ATOMIC_RELEASE);
        } else {
            for (int looks = 0; __atomic_load_n(round, __ATOMIC_ACQUIRE) == now; ++looks) {
                if (looks >= 50) {
                    geokit_yield();
                } else {
    #if defined(__x86_64__)
                    __builtin_ia32_pause();
    #elif defined(__aarch64__)
                    __builtin_arm_yield();
    #endif
                }
            }
        }
    }
};
