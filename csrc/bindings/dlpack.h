#pragma once

#include <cstdint>

/// The parts of the DLPack 1.x binary interface that reading a tensor needs. Layouts are fixed by that standard
/// (https://dmlc.github.io/dlpack); declared here so that no header of another package is needed to build.
namespace controlmm::dlpack {

enum DeviceType : std::int32_t { kCpu = 1 };
enum TypeCode : std::uint8_t { kInt = 0, kUInt = 1, kFloat = 2, kBool = 6 };

struct Device {
  std::int32_t type, id;
};

struct DataType {
  std::uint8_t code, bits;
  std::uint16_t lanes;
};

struct Tensor {
  void* data;
  Device device;
  std::int32_t ndim;
  DataType dtype;
  std::int64_t* shape;
  std::int64_t* strides;  // null before 1.2 for row-major memory
  std::uint64_t byte_offset;
};

struct Version {
  std::uint32_t major, minor;
};

/// What a capsule named "dltensor" points at starts with a Tensor; this is the "dltensor_versioned" kind.
struct VersionedTensor {
  Version version;
  void* manager_context;
  void (*deleter)(VersionedTensor*);
  std::uint64_t flags;
  Tensor tensor;
};
constexpr std::uint64_t kReadOnlyFlag = 1;

/// Table behind `type(tensor).__dlpack_c_exchange_api__`.
struct ExchangeApi {
  Version version;
  ExchangeApi* previous;
  void* allocate;
  void* managed_from_object;
  void* managed_to_object;
  int (*tensor_from_object)(void* object, Tensor* out);  // may be null; 0 on success, else a Python error is set
  void* current_stream;
};

}  // namespace controlmm::dlpack
