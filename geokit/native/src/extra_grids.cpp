#include "open_grids.h"

namespace geokit {

void register_extra_grids()
{
    if (!UInt32Grid::isRegistered()) UInt32Grid::registerGrid();
    if (!Vec4fGrid::isRegistered()) Vec4fGrid::registerGrid();
    if (!Vec4dGrid::isRegistered()) Vec4dGrid::registerGrid();
}

} // namespace geokit
