"""How deep the soft contacts of the ocean's bodies are, by their exact surfaces: many poses in a call.

python examples/ocean_contacts.py [--bodies 200] [--seconds 8] [--device cuda:0]

Lets the bodies of ocean.py float, then asks ``Surface.contacts`` once for each pair of shapes, with all poses of these.
"""

import argparse
import itertools

import numpy as np
import ocean
import warp as wp

import geokit as gk


def poses(scene):
    """Where each body is, (N, 4, 4), in float64."""
    made = np.tile(np.eye(4), (len(scene.kind), 1, 1))
    made[:, :3, 3] = scene.b.x.numpy()
    for pose, turn in zip(made, scene.b.turn.numpy().tolist(), strict=True):
        pose[:3, :3] = np.array(wp.quat_to_matrix(wp.normalize(wp.quatd(*turn)))).reshape(3, 3)
    return made


def touching(scene):
    """Depth [m] of the deepest point of each contact of two bodies, (N,)."""
    pose, near = poses(scene), scene.grid.candidates(exclude_self=True)
    j, i = near.indices.numpy(), np.repeat(np.arange(len(pose)), np.diff(near.offsets.numpy()))
    bodies = [gk.mesh.Surface(made.mesh, device=scene.device) for made in scene.made]
    found = [np.zeros(0)]
    for one, other in itertools.combinations_with_replacement(range(len(bodies)), 2):
        pair = (scene.kind[i] == one) & (scene.kind[j] == other) & ((i < j) | (one != other))
        seen = np.linalg.inv(pose[j[pair]]) @ pose[i[pair]]  # the first where the second stands still
        found.append(bodies[one].contacts(bodies[other], transform=seen).depths[:, 0])
    return np.concatenate(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    args = parser.parse_args()
    solid = gk.mesh.Surface(ocean.harbor(), device=args.device)
    kind, x = ocean.fleet(args.bodies, solid)
    scene = ocean.Ocean(ocean.kinds(), kind, x, solid=solid, device=args.device)
    for _ in range(round(60 * args.seconds)):
        scene.frame()
    deep = touching(scene)
    print(f"{len(x)} bodies, {len(deep)} contacts of two, the deepest {100 * deep.max(initial=0.0):.1f} cm")


if __name__ == "__main__":
    main()
