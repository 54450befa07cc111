// Gives OpenVDB's tools the pulse of an operation.
#pragma once

#include "pulse.h"

#include <openvdb/util/NullInterrupter.h>

namespace geokit {

// The tools would go on with half-made values if it returned true; it throws instead.
struct Interrupter : openvdb::util::NullInterrupter {
    explicit Interrupter(const Pulse& pulse_) : pulse(pulse_) {}
    bool wasInterrupted(int = -1) override
    {
        pulse();
        return false;
    }
    const Pulse& pulse;
};

} // namespace geokit
