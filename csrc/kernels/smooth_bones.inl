// Bones of the right length for a whole clip at once, by damped Gauss-Newton steps.

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
inline void add_frame(const SmoothBonesArgs& args, std::int64_t t, double damping, const ClipSystem& system) {
  const BodyTree& body = args.body;
  const std::int64_t first = 3 * t * body.joints;
  const double* joints = args.joints + first;
  const double* start = args.start + first;
  const ClipSystem::Frame frame = system.frame(t);
  for (std::int64_t j = 0; j < body.joints; ++j) {
    const std::int64_t parent = body.parents[j];
    const double own = 1 + (args.feet[j] ? args.foot_resistance : 0);
    for (int c = 0; c < 3; ++c) {
      const std::int64_t k = 3 * j + c;
      const double change = joints[k] - start[k];
      frame.block(j, c, c) += own + damping;
      frame.right(k) -= own * change;
      if (parent < 0) continue;
      const std::int64_t up = 3 * parent + c;
      const double pull = args.stiffness * (change - (joints[up] - start[up]));
      frame.right(k) -= pull;
      frame.right(up) += pull;
    }
    if (parent < 0) continue;
    const Bone bone = bone_of(joints, j, parent);
    const double lacks = args.bone_weight * (args.lengths[j] - bone.length);
    system.add_bone(frame, j, bone.direction);
    for (int c = 0; c < 3; ++c) {
      frame.right(3 * j + c) += lacks * bone.direction[c];
      frame.right(3 * parent + c) -= lacks * bone.direction[c];
    }
  }
}

// From a frame to the next: changes go on, feet that stand do so, toes where they are.
inline void add_ties(const SmoothBonesArgs& args, std::int64_t t, const ClipSystem& system) {
  const std::int64_t joints = args.body.joints;
  const ClipSystem::Frame frame = system.frame(t), next_frame = system.frame(t + 1);
  for (std::int64_t j = 0; j < joints; ++j)
    for (int c = 0; c < 3; ++c) {
      const std::int64_t k = 3 * j + c, here = 3 * t * joints + k, next = here + 3 * joints;
      const double step = args.joints[next] - args.joints[here];
      const double change = step - (args.start[next] - args.start[here]);
      const bool stands = args.planted[t * joints + j] && !(args.held[here] && args.held[next]);
      const double standing = stands ? args.standing : 0;
      const double pull = args.steadiness * change + standing * (args.toes[j] ? step : change);
      ClipSystem::add_tie(frame, next_frame, j, c, args.steadiness + standing);
      frame.right(k) += pull;
      next_frame.right(k) -= pull;
    }
}

inline void smooth_bones(const SmoothBonesArgs& args, double* memory) {
  const BodyTree& body = args.body;
  const std::int64_t width = 3 * body.joints;
  ClipSystem system(body, args.held, args.stiffness, args.bone_weight, memory);
  for (std::int64_t n = 0; n < args.steps; ++n) {
    if (!(worst_bone(body, args.joints, args.lengths, body.frames) > args.enough)) return;
    system.clear();
    const double damping = n == 0 ? args.damping : args.later_damping;
    for (std::int64_t t = 0; t < body.frames; ++t) add_frame(args, t, damping, system);
    for (std::int64_t t = 0; t + 1 < body.frames; ++t) add_ties(args, t, system);
    system.solve();
    for (std::int64_t t = 0; t < body.frames; ++t) {
      const ClipSystem::Frame frame = system.frame(t);
      for (std::int64_t k = 0; k < width; ++k) args.joints[t * width + k] += frame.right(k);
    }
  }
}
