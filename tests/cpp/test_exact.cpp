// The kernels of the closed end through the C++ interface: worked by hand, held coordinates, refusals.
#include <limits>
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::row_major;
constexpr std::int64_t kFrames = 6, kJoints = 4;
constexpr std::size_t kWidth = 3 * kJoints;
constexpr controlmm::PoseWeights kWeights{10, 1e3, 100, 1e4, 1e5, 3e3, 1e3};

// A trunk with two limbs that sways, all bones a tenth too long.
struct Clip {
  std::int64_t parents[kJoints] = {-1, 0, 1, 1};
  double lengths[kJoints] = {9, 1, 0.5, 0.7};
  bool feet[kJoints] = {false, false, true, false}, toes[kJoints] = {false, false, true, false};
  bool held[kFrames][kJoints][3] = {}, planted[kFrames][kJoints] = {};
  std::vector<double> joints;

  Clip() : joints(kFrames * kWidth) {
    for (std::size_t t = 0; t < kFrames; ++t) {
      const double angle = 0.2 * static_cast<double>(t);
      for (std::size_t j = 1; j < kJoints; ++j)
        for (std::size_t c = 0; c < 3; ++c) {
          const double direction[3] = {std::cos(angle + static_cast<double>(j)),
                                       std::sin(angle + static_cast<double>(j)), 0};
          at(t, j, c) = at(t, static_cast<std::size_t>(parents[j]), c) + 1.1 * lengths[j] * direction[c];
        }
      held[t][0][0] = held[t][0][1] = true;
    }
    held[3][2][1] = true;
    planted[2][2] = planted[kFrames - 1][2] = true;
  }

  double& at(std::size_t t, std::size_t j, std::size_t c) { return joints[t * kWidth + 3 * j + c]; }

  double worst_bone() {
    double worst = 0;
    for (std::size_t t = 0; t < kFrames; ++t)
      for (std::size_t j = 1; j < kJoints; ++j) {
        double squared = 0;
        for (std::size_t c = 0; c < 3; ++c) {
          const double along = at(t, j, c) - at(t, static_cast<std::size_t>(parents[j]), c);
          squared += along * along;
        }
        worst = std::fmax(worst, std::fabs(std::sqrt(squared) - lengths[j]));
      }
    return worst;
  }

  bool keeps_what_is_held(const std::vector<double>& before) const {
    for (std::size_t i = 0; i < joints.size(); ++i)
      if ((&held[0][0][0])[i] && joints[i] != before[i]) return false;
    return true;
  }

  void project() {
    controlmm::project_change(row_major(parents, {kJoints}), row_major(&held[0][0][0], {kFrames, kJoints, 3}),
                              row_major(&planted[0][0], {kFrames, kJoints}), 10, 100, 1e4,
                              row_major(joints.data(), {kFrames, kJoints, 3}));
  }
  void smooth(double enough, const controlmm::PoseWeights& weights = kWeights) {
    const std::vector<double> start = joints;
    controlmm::smooth_bones(row_major(parents, {kJoints}), row_major(start.data(), {kFrames, kJoints, 3}),
                            row_major(lengths, {kJoints}), row_major(&held[0][0][0], {kFrames, kJoints, 3}),
                            row_major(&planted[0][0], {kFrames, kJoints}), row_major(feet, {kJoints}),
                            row_major(toes, {kJoints}), weights, enough, 30,
                            row_major(joints.data(), {kFrames, kJoints, 3}));
  }
  void restore(std::int64_t joint_count = kJoints) {
    controlmm::frame_bones(row_major(parents, {joint_count}), row_major(lengths, {kJoints}),
                           row_major(&held[0][0][0], {kFrames, kJoints, 3}),
                           row_major(&planted[0][0], {kFrames, kJoints}), row_major(feet, {kJoints}), kWeights, 1e-9,
                           1e-9, 0.05, 40, row_major(joints.data(), {kFrames, kJoints, 3}));
  }
};

void a_neighbour_follows_by_ten_elevenths() {
  const std::int64_t parents[2] = {-1, 0};
  const bool held[1][2][3] = {{{false, false, false}, {true, false, false}}}, planted[1][2] = {};
  double change[1][2][3] = {{{7, 7, 7}, {1.1, 7, 7}}};  // smallest 10 (x - 1.1)^2 + x^2
  controlmm::project_change(row_major(parents, {2}), row_major(&held[0][0][0], {1, 2, 3}),
                            row_major(&planted[0][0], {1, 2}), 10, 100, 1e4, row_major(&change[0][0][0], {1, 2, 3}));
  CHECK(is_close(change[0][0][0], 1, 1e-12));
  CHECK(change[0][1][0] == 1.1);
  for (int c = 1; c < 3; ++c) CHECK(change[0][0][c] == 0 && change[0][1][c] == 0);
}

void wanted_changes_are_met_and_others_never_read() {
  Clip clip;
  for (std::size_t i = 0; i < clip.joints.size(); ++i)
    if (!(&clip.held[0][0][0])[i]) clip.joints[i] = std::numeric_limits<double>::quiet_NaN();
  const std::vector<double> wanted = clip.joints;
  clip.project();
  CHECK(clip.keeps_what_is_held(wanted));
  for (const double value : clip.joints) CHECK(std::isfinite(value));
}

void bones_get_their_lengths_and_held_coordinates_stay() {
  Clip clip;
  const std::vector<double> before = clip.joints;
  clip.smooth(0.01);
  CHECK(clip.worst_bone() <= 0.01);
  CHECK(clip.keeps_what_is_held(before));
  clip.restore();
  CHECK(clip.worst_bone() < 1e-9);
  CHECK(clip.keeps_what_is_held(before));
}

// Far harder for gradients than any weights of ours: what holds a frame by itself is next to nothing.
void steady_changes_are_the_same_in_all_frames() {
  Clip clip;
  for (auto& frame : clip.held)
    for (auto& joint : frame)
      for (bool& is_held : joint) is_held = false;
  const std::vector<double> before = clip.joints;
  controlmm::PoseWeights weights = kWeights;
  weights.steadiness = 1e10;
  clip.smooth(1e-3, weights);
  double change = 0, difference = 0;
  for (std::size_t i = kWidth; i < clip.joints.size(); ++i) {
    const double own = clip.joints[i] - before[i];
    change = std::fmax(change, std::fabs(own));
    difference = std::fmax(difference, std::fabs(own - (clip.joints[i - kWidth] - before[i - kWidth])));
  }
  CHECK(change > 0.01);
  CHECK(difference < 1e-3 * change);
}

void whole_bones_are_left_alone() {
  Clip clip;
  clip.restore();
  const std::vector<double> before = clip.joints;
  clip.smooth(1e-8);
  clip.restore();
  CHECK(clip.joints == before);
}

// A column of two bones without local rotations, the lower of which falls to the side while the upper stays upright.
struct Column {
  std::int64_t parents[3] = {-1, 0, 1};
  bool starts[3] = {true, true, false};
  double before[1][3][3] = {{{0, 0, 0}, {0, 1, 0}, {0, 2, 0}}}, after[1][3][3] = {{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}}};
  double heading[1][4] = {{3, 0, 0, 0}}, rotations[1][2][6] = {{{1, 0, 0, 0, 1, 0}, {1, 0, 0, 0, 1, 0}}};

  void swing(std::int64_t joints = 3, std::int64_t bones = 2) {
    controlmm::swing_rotations(row_major(parents, {joints}), row_major(starts, {joints}),
                               row_major(&before[0][0][0], {1, joints, 3}), row_major(&after[0][0][0], {1, 3, 3}),
                               row_major(&heading[0][0], {1, 4}), row_major(&rotations[0][0][0], {1, bones, 6}));
  }
  bool has(const double (&expected)[2][6]) const {
    for (int b = 0; b < 2; ++b)
      for (int i = 0; i < 6; ++i)
        if (!is_close(rotations[0][b][i], expected[b][i], 1e-15)) return false;
    return true;
  }
};

void rotations_follow_their_bones() {
  Column column, apart;
  column.swing();
  CHECK(column.has({{0, -1, 0, 1, 0, 0}, {0, 1, 0, -1, 0, 0}}));  // a quarter turn about z, and back
  apart.starts[2] = true;
  apart.swing();
  CHECK(apart.has({{0, -1, 0, 1, 0, 0}, {1, 0, 0, 0, 1, 0}}));
  Column flat;
  flat.after[0][2][0] = 1;
  flat.after[0][2][1] = 0;  // the upper bone has no length
  flat.swing();
  CHECK(flat.rotations[0][0][1] == -1 && std::isnan(flat.rotations[0][1][0]));
}

void what_does_not_fit_is_refused() {
  Clip clip;
  clip.parents[2] = 2;
  const auto has = [](const std::string& text, const char* part) { return text.find(part) != std::string::npos; };
  CHECK(has(refusal([&] { clip.project(); }), "`parents` must name an earlier joint"));
  CHECK(has(refusal([&] { clip.smooth(1); }), "got 2 for joint 2"));
  clip.parents[2] = -1;
  CHECK(has(refusal([&] { clip.restore(); }), "got -1 for joint 2"));
  clip.parents[2] = 1;
  clip.parents[0] = 0;
  CHECK(has(refusal([&] { clip.restore(); }), "got 0 for joint 0"));
  CHECK(has(refusal([&] { Clip().restore(3); }), "`parents`"));
  CHECK(has(refusal([&] { Column().swing(3, 3); }), "`rotations`"));
  CHECK(has(refusal([&] { Column().swing(2, 1); }), "`after`"));
}

}  // namespace

int main() {
  for (const std::string& isa : controlmm::available_isas()) {
    controlmm::set_isa(isa);
    a_neighbour_follows_by_ten_elevenths();
    wanted_changes_are_met_and_others_never_read();
    bones_get_their_lengths_and_held_coordinates_stay();
    steady_changes_are_the_same_in_all_frames();
    whole_bones_are_left_alone();
    rotations_follow_their_bones();
    what_does_not_fit_is_refused();
  }
}
