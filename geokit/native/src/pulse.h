#pragma once

#include <functional>

namespace geokit {

// Long operations call it between pieces of work, from several threads. It throws where they are to stop.
using Pulse = std::function<void()>;

} // namespace geokit
