// Bones of the right length for a whole clip at once, by damped Gauss-Newton steps on a banded system.

struct Bone {
  double direction[3], length;
};

inline Bone bone_of(const double* frame, std::int64_t child, std::int64_t parent) {
  Bone bone;
  double squared = 0;
  for (int c = 0; c < 3; ++c) {
    bone.direction[c] = frame[3 * child + c] - frame[3 * parent + c];
    squared += bone.direction[c] * bone.direction[c];
  }
  bone.length = std::sqrt(squared);
  const double length = bone.length < 1e-9 ? 1e-9 : bone.length;
  for (double& d : bone.direction) d /= length;
  return bone;
}

inline double worst_bone(const BodyTree& body, const double* joints, const double* lengths, std::int64_t frames) {
  double worst = 0;
  for (std::int64_t t = 0; t < frames; ++t)
    for (std::int64_t j = 1; j < body.joints; ++j) {
      const double error = std::fabs(lengths[j] - bone_of(joints + 3 * t * body.joints, j, body.parents[j]).length);
      if (error > worst || error != error) worst = error;  // one that is no number stays
    }
  return worst;
}

// Resistance of the joints against change within a frame, and what bones pull with.
inline void add_frame(const SmoothBonesArgs& args, std::int64_t t, double damping, Banded& system, double* force) {
  const BodyTree& body = args.body;
  const std::int64_t first = 3 * t * body.joints;
  const double* joints = args.joints + first;
  const double* start = args.start + first;
  for (std::int64_t j = 0; j < body.joints; ++j) {
    const std::int64_t parent = body.parents[j];
    for (int c = 0; c < 3; ++c) {
      const std::int64_t k = 3 * j + c;
      const double own = 1 + (args.feet[j] ? args.foot_resistance : 0), change = joints[k] - start[k];
      system.add(first + k, first + k, own + damping);
      force[first + k] -= own * change;
      if (parent < 0) continue;
      const std::int64_t up = 3 * parent + c;
      const double pull = args.stiffness * (change - (joints[up] - start[up]));
      system.tie(first + k, first + up, args.stiffness);
      force[first + k] -= pull;
      force[first + up] += pull;
    }
    if (parent < 0) continue;
    const Bone bone = bone_of(joints, j, parent);
    const double lacks = args.bone_weight * (args.lengths[j] - bone.length);
    for (int a = 0; a < 3; ++a) {
      const std::int64_t own = first + 3 * j + a, up = first + 3 * parent + a;
      force[own] += lacks * bone.direction[a];
      force[up] -= lacks * bone.direction[a];
      for (int b = 0; b < 3; ++b) {
        const double weight = args.bone_weight * bone.direction[a] * bone.direction[b];
        const std::int64_t own_b = first + 3 * j + b, up_b = first + 3 * parent + b;
        system.add(own, up_b, -weight);
        if (b > a) continue;
        system.add(own, own_b, weight);
        system.add(up, up_b, weight);
      }
    }
  }
}

// From a frame to the next: changes go on, feet that stand do so, toes where they are.
inline void add_ties(const SmoothBonesArgs& args, std::int64_t t, Banded& system, double* force) {
  const std::int64_t width = 3 * args.body.joints, first = t * width;
  for (std::int64_t k = 0; k < width; ++k) {
    const std::int64_t here = first + k, next = here + width, joint = t * args.body.joints + k / 3;
    const double step = args.joints[next] - args.joints[here];
    const double change = step - (args.start[next] - args.start[here]);
    const bool stands = args.planted[joint] && !(args.held[here] && args.held[next]);
    const double standing = stands ? args.standing : 0;
    const double pull = args.steadiness * change + standing * (args.toes[k / 3] ? step : change);
    system.tie(next, here, args.steadiness + standing);
    force[here] += pull;
    force[next] -= pull;
  }
}

inline void smooth_bones(const SmoothBonesArgs& args, double* memory) {
  const BodyTree& body = args.body;
  const std::int64_t reach = 3 * body.joints, count = body.frames * reach;
  Banded system(memory, count, reach);
  double* step = memory + banded_scratch(count, reach);
  for (std::int64_t n = 0; n < args.steps; ++n) {
    if (!(worst_bone(body, args.joints, args.lengths, body.frames) > args.enough)) return;
    if (n > 0) system.clear();
    const double damping = n == 0 ? args.damping : args.later_damping;
    for (std::int64_t i = 0; i < count + banded_stride(reach); ++i) step[i] = 0;
    for (std::int64_t t = 0; t < body.frames; ++t) add_frame(args, t, damping, system, step);
    for (std::int64_t t = 0; t + 1 < body.frames; ++t) add_ties(args, t, system, step);
    for (std::int64_t i = 0; i < count; ++i)
      if (args.held[i]) step[i] = 0;
    system.hold(args.held, 1, step);
    system.factorise();
    system.solve(step);
    for (std::int64_t i = 0; i < count; ++i) args.joints[i] += step[i];
  }
}
