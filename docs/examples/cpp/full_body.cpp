// A whole body from head and hands: full_body body.onnx trackers.csv > joints.csv
//
// body.onnx is what `memmlp export RUN --scope full --space SPACE --out body.onnx` writes. trackers.csv has a
// header and one row for each frame at 60 Hz: x, y, z in metres and a quaternion qx, qy, qz, qw of head, left
// and right wrist, in SPACE. What comes out are the 22 joints of each frame, metres, in SPACE.
#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <iterator>
#include <numeric>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

struct Pose {
  std::array<float, 3> position;    // metres
  std::array<float, 4> quaternion;  // x, y, z, w
};
using Trackers = std::array<Pose, 3>;  // head, left and right wrist

// The matrix, row by row, of a unit quaternion.
std::array<float, 9> matrix(const std::array<float, 4>& q) {
  const auto [x, y, z, w] = q;
  return {1 - 2 * (y * y + z * z), 2 * (x * y - z * w),     2 * (x * z + y * w),
          2 * (x * y + z * w),     1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
          2 * (x * z - y * w),     2 * (y * z + x * w),     1 - 2 * (x * x + y * y)};
}

// The network with its memory: one step for each frame at 60 Hz.
class FullBody {
 public:
  explicit FullBody(const char* path) : session_(environment_, path, options()) {
    Ort::AllocatorWithDefaultOptions allocator;
    const auto scope = session_.GetModelMetadata().LookupCustomMetadataMapAllocated("scope", allocator);
    if (!scope || std::string(scope.get()) != "full")
      throw std::runtime_error(std::string(path) + ": not written by memmlp export with --scope full");
    for (size_t index = 0; index < session_.GetInputCount(); ++index) {
      const std::string name = session_.GetInputNameAllocated(index, allocator).get();
      if (name.rfind("state.", 0) == 0) {
        states_.push_back(name);
        shapes_.push_back(session_.GetInputTypeInfo(index).GetTensorTypeAndShapeInfo().GetShape());
      }
    }
    reset();
  }

  // Forget the past: a fresh start is zeros.
  void reset() {
    state_.clear();
    Ort::AllocatorWithDefaultOptions allocator;
    for (const auto& shape : shapes_) {
      state_.push_back(Ort::Value::CreateTensor<float>(allocator, shape.data(), shape.size()));
      std::fill_n(state_.back().GetTensorMutableData<float>(), count(shape), 0.0f);
    }
  }

  // Take in one frame. `rotations` holds 22 matrices afterwards, row by row, each relative to its parent's and
  // the root's global; `positions` 22 x 3 metres, by forward kinematics.
  void step(const Trackers& trackers) {
    std::array<float, 9> places;
    std::array<float, 27> turns;
    for (size_t k = 0; k < trackers.size(); ++k) {
      std::copy_n(trackers[k].position.begin(), 3, places.begin() + 3 * k);
      std::copy_n(matrix(trackers[k].quaternion).begin(), 9, turns.begin() + 9 * k);
    }
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const std::array<int64_t, 3> place_shape{1, 3, 3};
    const std::array<int64_t, 4> turn_shape{1, 3, 3, 3};
    std::vector<Ort::Value> given;
    given.push_back(Ort::Value::CreateTensor<float>(memory, places.data(), 9, place_shape.data(), 3));
    given.push_back(Ort::Value::CreateTensor<float>(memory, turns.data(), 27, turn_shape.data(), 4));
    std::move(state_.begin(), state_.end(), std::back_inserter(given));

    std::vector<const char*> inputs{"tracker_positions", "tracker_rotations"}, outputs{"rotations", "positions"};
    std::vector<std::string> next;
    for (const auto& name : states_) next.push_back(name + ".next");
    for (const auto& name : states_) inputs.push_back(name.c_str());
    for (const auto& name : next) outputs.push_back(name.c_str());

    auto made = session_.Run(Ort::RunOptions{}, inputs.data(), given.data(), given.size(), outputs.data(),
                             outputs.size());
    rotations = values(made[0]);
    positions = values(made[1]);
    state_.assign(std::make_move_iterator(made.begin() + 2), std::make_move_iterator(made.end()));
  }

  // The joints' names, from the file's metadata: ["pelvis", "left_hip", ...].
  std::vector<std::string> joints() const {
    Ort::AllocatorWithDefaultOptions allocator;
    std::string list = session_.GetModelMetadata().LookupCustomMetadataMapAllocated("joints", allocator).get();
    for (const char mark : {'[', ']', '"', ' '}) list.erase(std::remove(list.begin(), list.end(), mark), list.end());
    std::vector<std::string> names;
    std::istringstream words(list);
    for (std::string name; std::getline(words, name, ',');) names.push_back(name);
    return names;
  }

  std::vector<float> rotations, positions;

 private:
  static Ort::SessionOptions options() {
    Ort::SessionOptions made;
    made.SetIntraOpNumThreads(1);  // quicker than more for so small a network
    return made;
  }

  static size_t count(const std::vector<int64_t>& shape) {
    return std::accumulate(shape.begin(), shape.end(), size_t{1}, std::multiplies<size_t>());
  }

  static std::vector<float> values(const Ort::Value& tensor) {
    const float* data = tensor.GetTensorData<float>();
    return {data, data + tensor.GetTensorTypeAndShapeInfo().GetElementCount()};
  }

  Ort::Env environment_{ORT_LOGGING_LEVEL_WARNING, "full_body"};
  Ort::Session session_;
  std::vector<std::string> states_;
  std::vector<std::vector<int64_t>> shapes_;
  std::vector<Ort::Value> state_;
};

// The 21 numbers of a row. A lost tracker is refused: NaN would stay in the network's memory for ever.
Trackers read_frame(const std::string& line, const std::string& where) {
  std::vector<float> row;
  std::istringstream words(line);
  for (std::string word; std::getline(words, word, ',');) {
    try {
      row.push_back(std::stof(word));
    } catch (const std::exception&) {
      row.push_back(NAN);
    }
  }
  Trackers trackers;
  bool right = row.size() == 21;
  for (size_t k = 0; right && k < 3; ++k) {
    std::copy_n(row.begin() + 7 * k, 3, trackers[k].position.begin());
    std::copy_n(row.begin() + 7 * k + 3, 4, trackers[k].quaternion.begin());
    const auto [x, y, z, w] = trackers[k].quaternion;
    right = std::abs(std::sqrt(x * x + y * y + z * z + w * w) - 1) < 1e-2 &&
            std::all_of(row.begin(), row.end(), [](float value) { return std::isfinite(value); });
  }
  if (!right) throw std::runtime_error(where + ": not 3 x (three metres and a unit quaternion)");
  return trackers;
}

void play(const char* network, const char* path) {
  FullBody body(network);
  std::ifstream file(path);
  if (!file) throw std::runtime_error(std::string(path) + ": cannot be read");
  const char* comma = "";
  for (const auto& name : body.joints())
    for (const char axis : {'x', 'y', 'z'}) std::printf("%s%s.%c", std::exchange(comma, ","), name.c_str(), axis);
  std::printf("\n");
  std::string line;
  std::getline(file, line);  // the header
  for (int number = 2; std::getline(file, line); ++number) {
    body.step(read_frame(line, path + std::string(": line ") + std::to_string(number)));
    for (size_t k = 0; k < body.positions.size(); ++k) std::printf("%s%.6f", k ? "," : "", body.positions[k]);
    std::printf("\n");
  }
}

int main(int count, char** words) {
  if (count != 3) {
    std::fprintf(stderr, "usage: full_body body.onnx trackers.csv > joints.csv\n");
    return 2;
  }
  try {
    play(words[1], words[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
