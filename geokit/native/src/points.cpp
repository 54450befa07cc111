#include "points.h"

#include "vdb_file.h"

#include <openvdb/points/AttributeArrayString.h>
#include <openvdb/points/AttributeGroup.h>
#include <openvdb/points/PointDataGrid.h>

#include <cstring>
#include <map>

// As in library_grids.h; only this file needs the type.
#ifdef GEOKIT_LIBRARY_GRIDS
namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {
extern template class tree::Tree<points::PointDataTree::RootNodeType>;
extern template class Grid<points::PointDataTree>;
} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb
#endif

namespace geokit {
namespace {

using openvdb::Index;
using openvdb::points::AttributeArray;
using openvdb::points::AttributeHandle;
using openvdb::points::AttributeSet;
using openvdb::points::AttributeWriteHandle;
using openvdb::points::PointDataGrid;
using openvdb::points::PointDataTree;
using Leaf = PointDataTree::LeafNodeType;

// The name under which the note lies in the grid's metadata.
const char kNote[] = "geokit:arrays";

// Appends the attribute of a leaf's points to the rows in `bytes`.
template<typename T>
void append(const AttributeArray& array, std::string& bytes)
{
    const auto handle = AttributeHandle<T>::create(array);
    const Index count = array.size(), stride = array.stride();
    size_t at = bytes.size();
    bytes.resize(at + size_t(count) * stride * sizeof(T));
    for (Index i = 0; i < count; ++i) {
        for (Index j = 0; j < stride; ++j, at += sizeof(T)) {
            const T value = handle->get(i, j);
            std::memcpy(&bytes[at], &value, sizeof value);
        }
    }
}

template<typename T>
void assign(AttributeArray& array, const uint8_t* bytes)
{
    const auto handle = AttributeWriteHandle<T>::create(array);
    const Index count = array.size(), stride = array.stride();
    for (Index i = 0; i < count; ++i) {
        for (Index j = 0; j < stride; ++j, bytes += sizeof(T)) {
            T value;
            std::memcpy(&value, bytes, sizeof value);
            handle->set(i, j, value);
        }
    }
    array.compact(); // equal values are stored once
}

struct ValueType {
    Index components;
    size_t size; // of one value, with all its components
    void (*append)(const AttributeArray&, std::string&);
    void (*assign)(AttributeArray&, const uint8_t*);
};

template<typename T>
ValueType value_type(Index components)
{ return {components, sizeof(T), &append<T>, &assign<T>}; }

// The types of numbers that OpenVDB registers, by its names.
const std::map<std::string, ValueType>& value_types()
{
    static const std::map<std::string, ValueType> types
        = {{"bool", value_type<bool>(1)}, {"int8", value_type<int8_t>(1)}, {"int16", value_type<int16_t>(1)},
            {"int32", value_type<int32_t>(1)}, {"int64", value_type<int64_t>(1)}, {"float", value_type<float>(1)},
            {"double", value_type<double>(1)}, {"vec3i", value_type<openvdb::Vec3i>(3)},
            {"vec3s", value_type<openvdb::Vec3s>(3)}, {"vec3d", value_type<openvdb::Vec3d>(3)},
            {"quats", value_type<openvdb::Quats>(4)}, {"quatd", value_type<openvdb::Quatd>(4)}};
    return types;
}

// Checks what the handles trust, and the offsets.
void check(const Leaf& leaf, const AttributeSet::Descriptor& first)
{
    if (!(leaf.attributeSet().descriptor() == first))
        throw BridgeError("damaged", "its leaves have different attributes");
    leaf.validateOffsets();
    for (size_t i = 0; i < leaf.attributeSet().size(); ++i) {
        const AttributeArray& array = leaf.constAttributeArray(i);
        if (array.hasConstantStride() && uint64_t(array.size()) * array.stride() != array.dataSize()) {
            throw BridgeError("damaged", "an attribute has the wrong size");
        }
    }
}

class TableReader {
public:
    TableReader(const PointDataGrid& grid, const AttributeSet::Descriptor& descriptor, const Leaf& first)
        : transform_(grid.transform()), descriptor_(descriptor), position_(descriptor.find("P"))
    {
        if (position_ == AttributeSet::INVALID_POS || descriptor.valueType(position_) != "vec3s") {
            throw BridgeError("unsupported", "it has points without a position 'P' of type vec3s");
        }
        std::map<size_t, std::string> names; // map() is sorted by name, positions are the file's order
        for (const auto& [name, position] : descriptor.map()) names[position] = name;
        for (const auto& [position, name] : names) {
            const AttributeArray& array = first.constAttributeArray(position);
            if (position == position_ || openvdb::points::isGroup(array)) continue;
            const auto& type = descriptor.valueType(position);
            const auto found = value_types().find(type);
            if (found == value_types().end() || openvdb::points::isString(array) || !array.hasConstantStride()) {
                table_.left_out.push_back(name);
                continue;
            }
            sources_.push_back({position, &found->second});
            table_.columns.push_back({name, type, uint64_t(array.stride()) * found->second.components, ""});
        }
        group_start_ = table_.columns.size();
        for (const auto& [name, offset] : descriptor.groupMap()) {
            groups_.push_back(descriptor.groupIndex(offset));
            table_.columns.push_back({name, "group", 1, ""});
        }
    }

    void add(const Leaf& leaf)
    {
        check(leaf, descriptor_);
        const auto position = AttributeHandle<openvdb::Vec3f>::create(leaf.constAttributeArray(position_));
        Index point = 0;
        for (Index voxel = 0; voxel < Leaf::SIZE; ++voxel) {
            const openvdb::Vec3d center = leaf.offsetToGlobalCoord(voxel).asVec3d();
            for (const Index end = leaf.getValue(voxel); point < end; ++point) {
                const auto world = transform_.indexToWorld(center + openvdb::Vec3d(position->get(point)));
                table_.positions.insert(table_.positions.end(), {world.x(), world.y(), world.z()});
            }
        }
        for (size_t i = 0; i < sources_.size(); ++i) {
            const AttributeArray& array = leaf.constAttributeArray(sources_[i].position);
            auto& column = table_.columns[i];
            if (!array.hasConstantStride() || uint64_t(array.stride()) * sources_[i].type->components != column.width) {
                throw BridgeError("damaged", "the rows of attribute '" + column.name + "' differ in width");
            }
            sources_[i].type->append(array, column.bytes);
        }
        for (size_t i = 0; i < groups_.size(); ++i) {
            const auto members = leaf.groupHandle(groups_[i]);
            auto& bytes = table_.columns[group_start_ + i].bytes;
            for (Index k = 0; k < point; ++k) bytes += char(members.get(k));
        }
    }

    PointTable take() { return std::move(table_); }

private:
    struct Source {
        size_t position;
        const ValueType* type;
    };

    const openvdb::math::Transform& transform_;
    const AttributeSet::Descriptor& descriptor_;
    size_t position_;
    std::vector<Source> sources_;
    std::vector<AttributeSet::Descriptor::GroupIndex> groups_;
    size_t group_start_ = 0;
    PointTable table_;
};

} // namespace

PointTable read_points(const std::string& path, const std::string& name)
{
    VdbFile file(path);
    const auto base = file.read_points(name);
    const auto grid = openvdb::gridPtrCast<PointDataGrid>(base);
    if (!grid) throw BridgeError("damaged", "it names a type of points that does not exist");
    PointTable table;
    try {
        auto leaf = grid->constTree().cbeginLeaf();
        if (leaf) {
            const auto& descriptor = leaf->attributeSet().descriptor();
            TableReader reader(*grid, descriptor, *leaf);
            for (; leaf; ++leaf) {
                pulse_if_any();
                reader.add(*leaf);
            }
            table = reader.take();
        }
    } catch (const openvdb::Exception& error) {
        throw BridgeError("damaged", error.what());
    }
    table.name = grid->getName();
    if (const auto note = grid->getMetadata<openvdb::StringMetadata>(kNote)) table.note = note->value();
    return table;
}

void write_points(const std::string& path, const PointLeaves& points, const std::string& compression)
{
    initialize();
    const auto grid = openvdb::StaticPtrCast<PointDataGrid>(openvdb::GridBase::createGrid(PointDataGrid::gridType()));
    // One description for all leaves, built up attribute after attribute, as they are added to a leaf.
    std::vector<AttributeSet::Descriptor::Ptr> descriptors = {AttributeSet::Descriptor::create({"vec3s", "null"})};
    std::vector<const ValueType*> types;
    for (const auto& column : points.columns) {
        descriptors.push_back(descriptors.back()->duplicateAppend(column.name, {column.type, "null"}));
        types.push_back(&value_types().at(column.type));
    }
    for (uint64_t i = 0; i < points.leaf_count; ++i) {
        pulse_if_any();
        const int64_t start = points.starts[i], count = points.starts[i + 1] - start;
        auto leaf = std::make_unique<Leaf>(openvdb::Coord(points.corners + 3 * i));
        leaf->initializeAttributes(descriptors[0], Index(count));
        std::vector<Leaf::ValueType> ends(Leaf::SIZE);
        int64_t k = 0;
        for (Index voxel = 0; voxel < Leaf::SIZE; ++voxel) {
            while (k < count && points.voxels[start + k] == voxel) ++k;
            ends[voxel] = uint32_t(k);
        }
        leaf->setOffsets(ends);
        assign<openvdb::Vec3f>(leaf->attributeArray(0), reinterpret_cast<const uint8_t*>(points.positions + 3 * start));
        for (size_t k = 0; k < types.size(); ++k) {
            const Index stride = Index(points.columns[k].width / types[k]->components);
            const auto array = leaf->appendAttribute(*descriptors[k], descriptors[k + 1], k + 1, stride);
            types[k]->assign(*array, points.bytes[k] + uint64_t(start) * stride * types[k]->size);
        }
        grid->tree().addLeaf(leaf.release());
    }
    const double size = points.voxel_size;
    grid->setTransform(transform_of(
        {{{size, 0, 0}, {0, size, 0}, {0, 0, size}}, {points.origin[0], points.origin[1], points.origin[2]}}));
    grid->setName(points.name);
    grid->insertMeta(kNote, openvdb::StringMetadata(points.note));
    save_grids(path, {grid}, compression);
}

} // namespace geokit
