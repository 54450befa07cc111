// The NanoVDB grid types that the bridge supports, and dispatch on them.
#pragma once

#include "bridge.h"

#include <nanovdb/NanoVDB.h>

namespace geokit {

template<typename T>
struct BuildTag {
    using Type = T;
};

// Calls op(BuildTag<T>()) with the build type T of a NanoVDB grid type. Not supported: Half (NanoVDB's C++ stores 32
// bits a voxel, its C readers expect 16), RGBA8, Int16 and Index (no OpenVDB grid has such values).
template<typename Op>
auto dispatch(nanovdb::GridType type, Op&& op)
{
    using nanovdb::GridType;
    switch (type) {
    case GridType::Float: return op(BuildTag<float>());
    case GridType::Double: return op(BuildTag<double>());
    case GridType::Int32: return op(BuildTag<int32_t>());
    case GridType::Int64: return op(BuildTag<int64_t>());
    case GridType::UInt32: return op(BuildTag<uint32_t>());
    case GridType::Vec3f: return op(BuildTag<nanovdb::Vec3f>());
    case GridType::Vec3d: return op(BuildTag<nanovdb::Vec3d>());
    case GridType::Vec4f: return op(BuildTag<nanovdb::Vec4f>());
    case GridType::Vec4d: return op(BuildTag<nanovdb::Vec4d>());
    case GridType::Boolean: return op(BuildTag<bool>());
    case GridType::Mask: return op(BuildTag<nanovdb::ValueMask>());
    case GridType::Fp4: return op(BuildTag<nanovdb::Fp4>());
    case GridType::Fp8: return op(BuildTag<nanovdb::Fp8>());
    case GridType::Fp16: return op(BuildTag<nanovdb::Fp16>());
    case GridType::FpN: return op(BuildTag<nanovdb::FpN>());
    default: break;
    }
    const bool known = type > GridType::Unknown && type < GridType::End;
    throw BridgeError("unsupported",
        "a NanoVDB grid of type " + (known ? std::string(nanovdb::toStr(type)) : std::to_string(uint32_t(type)))
            + " has no OpenVDB counterpart");
}

} // namespace geokit
