#include "convert.h"

#include <openvdb/io/io.h>

#include <cmath>
#include <sstream>

namespace geokit {
namespace {

using namespace openvdb::math;

Affine diagonal(const openvdb::Vec3d& scale, const openvdb::Vec3d& offset)
{
    Affine affine{};
    for (int i = 0; i < 3; ++i) {
        affine.linear[i][i] = scale[i];
        affine.offset[i] = offset[i];
    }
    return affine;
}

bool is_diagonal(const Affine& affine)
{
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            if (i != j && affine.linear[i][j] != 0.0) return false;
        }
    }
    return true;
}

MapBase::Ptr map_of(const Affine& affine)
{
    const openvdb::Vec3d scale(affine.linear[0][0], affine.linear[1][1], affine.linear[2][2]);
    const openvdb::Vec3d offset(affine.offset);
    if (!is_diagonal(affine)) {
        // OpenVDB multiplies row vectors: its matrix is the transpose.
        Mat4d matrix = Mat4d::identity();
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) matrix(j, i) = affine.linear[i][j];
            matrix(3, i) = affine.offset[i];
        }
        return MapBase::Ptr(new AffineMap(matrix));
    }
    const bool is_uniform = scale[0] == scale[1] && scale[1] == scale[2];
    const bool is_moved = offset[0] != 0.0 || offset[1] != 0.0 || offset[2] != 0.0;
    if (is_uniform && is_moved) return MapBase::Ptr(new UniformScaleTranslateMap(scale[0], offset));
    if (is_uniform) return MapBase::Ptr(new UniformScaleMap(scale[0]));
    if (is_moved) return MapBase::Ptr(new ScaleTranslateMap(scale, offset));
    return MapBase::Ptr(new ScaleMap(scale));
}

void require_finite(const Affine& affine)
{
    for (int i = 0; i < 3; ++i) {
        bool is_finite = std::isfinite(affine.offset[i]);
        for (double value : affine.linear[i]) is_finite = is_finite && std::isfinite(value);
        if (!is_finite) throw BridgeError("damaged", "its transform is not finite");
    }
}

} // namespace

Affine affine_of(const Transform& transform)
{
    const auto map = transform.baseMap();
    if (!map->isLinear()) {
        throw BridgeError("unsupported", "its transform is a frustum; only affine transforms can be converted");
    }
    Affine affine{};
    const openvdb::Vec3d zero(0.0);
    if (const auto scaled = transform.constMap<UniformScaleMap>()) affine = diagonal(scaled->getScale(), zero);
    else if (const auto scaled = transform.constMap<ScaleMap>()) affine = diagonal(scaled->getScale(), zero);
    else if (const auto moved = transform.constMap<UniformScaleTranslateMap>())
        affine = diagonal(moved->getScale(), moved->getTranslation());
    else if (const auto moved = transform.constMap<ScaleTranslateMap>())
        affine = diagonal(moved->getScale(), moved->getTranslation());
    else {
        const Mat4d matrix = map->getAffineMap()->getMat4();
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) affine.linear[i][j] = matrix(j, i);
            affine.offset[i] = matrix(3, i);
        }
    }
    require_finite(affine);
    return affine;
}

Affine affine_of(const nanovdb::Map& map)
{
    Affine affine{};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) affine.linear[i][j] = map.mMatD[3 * i + j];
        affine.offset[i] = map.mVecD[i];
    }
    require_finite(affine);
    return affine;
}

Transform::Ptr transform_of(const Affine& affine)
{
    try {
        // Transform's constructor calls simplify(); reading one from a stream does not.
        const auto map = map_of(affine);
        std::stringstream stream(std::ios::in | std::ios::out | std::ios::binary);
        openvdb::io::setCurrentVersion(stream);
        openvdb::writeString(stream, map->type());
        map->write(stream);
        auto transform = std::make_shared<Transform>();
        transform->read(stream);
        return transform;
    } catch (const openvdb::ArithmeticError&) {
        throw BridgeError("input",
            "OpenVDB takes this transform as singular (the volume of a voxel must exceed 3e-15); scale the grid up");
    }
}

void store(const Affine& affine, nanovdb::Map& map)
{
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            map.mMatD[3 * i + j] = affine.linear[i][j];
            map.mMatF[3 * i + j] = float(affine.linear[i][j]);
        }
        map.mVecD[i] = affine.offset[i];
        map.mVecF[i] = float(affine.offset[i]);
    }
}

} // namespace geokit
