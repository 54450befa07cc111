#pragma once

#include <fstream>
#include <functional>

namespace geokit {

// Long operations call it between pieces of work, from several threads. It throws where they are to stop.
using Pulse = std::function<void()>;

// The pulse of the operation that this thread works for; null outside of one.
inline thread_local const Pulse* current_pulse = nullptr;

// Makes a pulse the current one of this thread while the object lives.
class PulseScope {
public:
    explicit PulseScope(const Pulse* pulse) : before_(current_pulse) { current_pulse = pulse; }
    PulseScope(const PulseScope&) = delete;
    PulseScope& operator=(const PulseScope&) = delete;
    ~PulseScope() { current_pulse = before_; }

private:
    const Pulse* before_;
};

// For steps that are called within operations and outside of them.
inline void pulse_if_any()
{
    if (current_pulse != nullptr) (*current_pulse)();
}

// The bytes of a file on their way in or out: OpenVDB reads and writes without an interrupter, but through a stream.
// Streams pass on what is thrown here if their exceptions() have badbit.
class PulsedFile : public std::filebuf {
protected:
    std::streamsize xsgetn(char* to, std::streamsize count) override
    {
        pulse_if_any();
        return std::filebuf::xsgetn(to, count);
    }
    std::streamsize xsputn(const char* from, std::streamsize count) override
    {
        pulse_if_any();
        return std::filebuf::xsputn(from, count);
    }
};

} // namespace geokit
