// The smallest smooth change of a clip that moves held coordinates by what they lack.

inline void add_bones(const BodyTree& body, std::int64_t frame, double stiffness, Banded& system) {
  for (std::int64_t j = 0; j < body.joints; ++j) {
    system.add(frame + j, frame + j, 1);
    if (body.parents[j] >= 0) system.tie(frame + j, frame + body.parents[j], stiffness);
  }
}

inline void add_smoothness(const BodyTree& body, double weight, Banded& system) {
  constexpr double kSecond[3] = {1, -2, 1};
  const std::int64_t joints = body.joints;
  for (std::int64_t i = 0; i < (body.frames - 2) * joints; ++i)
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b <= a; ++b) system.add(i + a * joints, i + b * joints, weight * kSecond[a] * kSecond[b]);
}

inline void project_axis(const ProjectionArgs& args, int axis, Banded& system, double* x) {
  const BodyTree& body = args.body;
  const std::int64_t joints = body.joints, count = body.frames * joints;
  const std::uint8_t* held = args.held + axis;
  system.clear();
  for (std::int64_t t = 0; t < body.frames; ++t) add_bones(body, t * joints, args.stiffness, system);
  add_smoothness(body, args.smoothness, system);
  for (std::int64_t i = 0; i < count - joints; ++i)
    if (args.planted[i] && !(held[3 * i] && held[3 * (i + joints)])) system.tie(i + joints, i, args.standing);
  for (std::int64_t i = 0; i < count; ++i) x[i] = held[3 * i] ? args.change[3 * i + axis] : 0;
  system.hold(held, 3, x);
  system.factorise();
  system.solve(x);
  for (std::int64_t i = 0; i < count; ++i) args.change[3 * i + axis] = x[i];
}

inline void project(const ProjectionArgs& args, double* memory) {
  const std::int64_t joints = args.body.joints, count = args.body.frames * joints, reach = 2 * joints;
  Banded system(memory, count, reach);
  double* x = memory + banded_scratch(count, reach);
  for (std::int64_t i = 0; i < banded_stride(reach); ++i) x[count + i] = 0;
  for (int axis = 0; axis < 3; ++axis) {
    bool any = false;
    for (std::int64_t i = 0; i < count; ++i) any = any || args.held[3 * i + axis];
    if (any) {
      project_axis(args, axis, system, x);
    } else {
      for (std::int64_t i = 0; i < count; ++i) args.change[3 * i + axis] = 0;
    }
  }
}
