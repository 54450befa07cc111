#include "convert.h"
#include "nano_types.h"
#include "open_grids.h" // before NanoVDB's converter, whose use of createGrid() it changes
#include "transform.h"

#include <nanovdb/util/NanoToOpenVDB.h>

namespace geokit {

openvdb::GridBase::Ptr to_openvdb(const uint8_t* data, bool as_vec3i)
{
    initialize();
    const auto& header = *reinterpret_cast<const nanovdb::GridData*>(data);
    const auto transform = transform_of(affine_of(header.mMap));
    openvdb::GridBase::Ptr grid = dispatch(header.mGridType, [&](auto tag) -> openvdb::GridBase::Ptr {
        using BuildT = typename decltype(tag)::Type;
        return nanovdb::nanoToOpenVDB(*reinterpret_cast<const nanovdb::NanoGrid<BuildT>*>(data));
    });
    if (as_vec3i) {
        const auto doubles = openvdb::gridPtrCast<openvdb::Vec3DGrid>(grid);
        if (!doubles) throw BridgeError("input", "only a vec3d buffer can be written as integer vectors");
        grid = to_vec3i(*doubles);
    }
    // NanoVDB's converter stores an unknown class as metadata, where most programs store none.
    if (grid->getGridClass() == openvdb::GRID_UNKNOWN) grid->clearGridClass();
    // NanoVDB's own transform was rounded by OpenVDB's simplify().
    grid->setTransform(transform);
    return grid;
}

} // namespace geokit
