// The bytes of a file on their way in or out: OpenVDB reads and writes without an interrupter, but through a stream.
#pragma once

#include "pulse.h"

#include <fstream>

namespace geokit {

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
