// Writes foreign_points.vdb: grids of points as other programs write them, with OpenVDB's own tools. By hand:
//   g++ -O1 -std=c++17 foreign_points.cpp -I/usr/include/Imath -lopenvdb -lImath-3_1 -ltbb -o foreign_points && ./foreign_points
#include <openvdb/openvdb.h>
#include <openvdb/points/PointAttribute.h>
#include <openvdb/points/PointConversion.h>
#include <openvdb/points/PointGroup.h>

#include <cmath>

using namespace openvdb;
using namespace openvdb::points;

// Point i of the file: the tests know the formulas.
Vec3d place(int i) { return Vec3d(0.37 * i, std::sin(1.3 * i), 2.0 + 0.1 * (i % 7)); }

template<typename Codec>
PointDataGrid::Ptr grid_of(int count, const char* name)
{
    std::vector<Vec3f> places, colors;
    std::vector<float> radii;
    std::vector<int> numbers;
    std::vector<short> marks;
    for (int i = 0; i < count; ++i) {
        places.push_back(Vec3f(place(i)));
        colors.push_back(Vec3f(0.25f * (i % 4), 0.5f, 1.0f));
        radii.push_back(0.125f * i);
        numbers.push_back(i);
        marks.push_back(i % 2);
    }
    const auto transform = math::Transform::createLinearTransform(0.5);
    transform->postTranslate(Vec3d(10, 20, 30));
    for (auto& p : places) p += Vec3f(10, 20, 30);
    const PointAttributeVector<Vec3f> wrapper(places);
    auto index = tools::createPointIndexGrid<tools::PointIndexGrid>(wrapper, *transform);
    auto grid = createPointDataGrid<Codec, PointDataGrid>(*index, wrapper, *transform);
    auto& tree = grid->tree();
    const auto& order = index->tree();
    appendAttribute<float, TruncateCodec>(tree, "pscale");
    populateAttribute(tree, order, "pscale", PointAttributeVector<float>(radii));
    appendAttribute<Vec3f>(tree, "Cd");
    populateAttribute(tree, order, "Cd", PointAttributeVector<Vec3f>(colors));
    appendAttribute<int32_t>(tree, "id");
    populateAttribute(tree, order, "id", PointAttributeVector<int>(numbers));
    appendAttribute<float>(tree, "weights", 1.5f, /*stride=*/4);  // uniform: stored once
    appendAttribute<Mat4d>(tree, "frame", Mat4d::identity());
    appendAttribute<Name, StringCodec<false>>(tree, "label");
    appendGroup(tree, "odd");
    setGroup(tree, order, marks, "odd");
    grid->setName(name);
    return grid;
}

int main()
{
    initialize();
    io::File file("foreign_points.vdb");
    const auto density = FloatGrid::create();
    density->setName("density");
    density->tree().setValue(Coord(1, 2, 3), 1.0f);
    file.write(GridCPtrVec{grid_of<NullCodec>(40, "spray"), density, grid_of<FixedPointCodec<false>>(20, "foam")});
}
