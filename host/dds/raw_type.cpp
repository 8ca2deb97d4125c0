#include "host/dds/raw_type.hpp"

#include <dds/ddsi/ddsi_serdata.h>
#include <dds/ddsi/ddsi_sertype.h>
#include <dds/ddsi/q_radmin.h>
#include <dds/ddsrt/heap.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <string>
#include <string_view>

namespace groma::dds {
namespace {

constexpr std::size_t kAlignment = 4;  // of what is sent

// The base comes first: Cyclone's pointers are to it.
struct RawData {
  ddsi_serdata base{};
  std::string bytes;  // padded to a multiple of kAlignment
  std::uint32_t size = 0;

  RawData(const ddsi_sertype* type, ddsi_serdata_kind kind) { ddsi_serdata_init(&base, type, kind); }

  void pad() {
    size = static_cast<std::uint32_t>(bytes.size());
    bytes.resize((bytes.size() + kAlignment - 1) / kAlignment * kAlignment);
  }
};

const RawData& of(const ddsi_serdata* data) {
  return *reinterpret_cast<const RawData*>(data);
}

ddsi_serdata* released(std::unique_ptr<RawData> data) {
  return &data.release()->base;
}

// ---- data

bool has_equal_key(const ddsi_serdata* /*a*/, const ddsi_serdata* /*b*/) {
  return true;
}

std::uint32_t size_of(const ddsi_serdata* data) {
  return of(data).size;
}

// Fragments may overlap.
ddsi_serdata* from_network(const ddsi_sertype* type, ddsi_serdata_kind kind, const nn_rdata* fragment,
                           std::size_t size) {
  auto data = std::make_unique<RawData>(type, kind);
  data->bytes.reserve(size);
  for (; fragment != nullptr; fragment = fragment->nextfrag) {
    if (fragment->maxp1 <= data->bytes.size()) continue;
    if (fragment->min > data->bytes.size()) return nullptr;
    const auto* const payload = NN_RMSG_PAYLOADOFF(fragment->rmsg, NN_RDATA_PAYLOAD_OFF(fragment));
    const std::size_t known = data->bytes.size() - fragment->min;
    data->bytes.append(reinterpret_cast<const char*>(payload) + known, fragment->maxp1 - data->bytes.size());
  }
  if (data->bytes.size() != size) return nullptr;
  data->pad();
  return released(std::move(data));
}

ddsi_serdata* from_parts(const ddsi_sertype* type, ddsi_serdata_kind kind, ddsrt_msg_iovlen_t count,
                         const ddsrt_iovec_t* parts, std::size_t size) {
  auto data = std::make_unique<RawData>(type, kind);
  data->bytes.reserve(size);
  for (std::size_t i = 0; i < static_cast<std::size_t>(count); ++i)
    data->bytes.append(static_cast<const char*>(parts[i].iov_base), parts[i].iov_len);
  if (data->bytes.size() != size) return nullptr;
  data->pad();
  return released(std::move(data));
}

ddsi_serdata* from_key(const ddsi_sertype* type, const ddsi_keyhash* /*key*/) {
  auto data = std::make_unique<RawData>(type, SDK_KEY);
  return released(std::move(data));
}

ddsi_serdata* from_sample(const ddsi_sertype* type, ddsi_serdata_kind kind, const void* sample) {
  auto data = std::make_unique<RawData>(type, kind);
  if (kind == SDK_DATA) data->bytes = *static_cast<const std::string_view*>(sample);
  data->pad();
  return released(std::move(data));
}

void to_bytes(const ddsi_serdata* data, std::size_t begin, std::size_t size, void* out) {
  std::memcpy(out, of(data).bytes.data() + begin, size);
}

ddsi_serdata* lend_bytes(const ddsi_serdata* data, std::size_t begin, std::size_t size, ddsrt_iovec_t* out) {
  out->iov_base = const_cast<char*>(of(data).bytes.data() + begin);
  out->iov_len = size;
  return ddsi_serdata_ref(data);
}

void return_bytes(ddsi_serdata* data, const ddsrt_iovec_t* /*lent*/) {
  ddsi_serdata_unref(data);
}

bool to_sample(const ddsi_serdata* data, void* sample, void** /*begin*/, void* /*end*/) {
  static_cast<std::string*>(sample)->assign(of(data).bytes, 0, of(data).size);
  return true;
}

ddsi_serdata* to_untyped(const ddsi_serdata* data) {
  auto key = std::make_unique<RawData>(data->type, SDK_KEY);
  key->base.type = nullptr;
  return released(std::move(key));
}

bool untyped_to_sample(const ddsi_sertype* /*type*/, const ddsi_serdata* /*data*/, void* sample,
                       void** /*begin*/, void* /*end*/) {
  static_cast<std::string*>(sample)->clear();
  return true;
}

void free_data(ddsi_serdata* data) {
  std::default_delete<RawData>()(reinterpret_cast<RawData*>(data));
}

std::size_t print(const ddsi_sertype* /*type*/, const ddsi_serdata* data, char* out, std::size_t size) {
  return static_cast<std::size_t>(
      std::max(0, std::snprintf(out, size, "%u bytes", static_cast<unsigned>(of(data).size))));
}

void to_key_hash(const ddsi_serdata* /*data*/, ddsi_keyhash* out, bool /*md5*/) {
  *out = {};
}

// ---- type

void free_type(ddsi_sertype* type) {
  ddsi_sertype_fini(type);
  std::default_delete<ddsi_sertype>()(type);
}

void clear_samples(const ddsi_sertype* /*type*/, void* samples, std::size_t count) {
  for (std::size_t i = 0; i < count; ++i) static_cast<std::string*>(samples)[i].clear();
}

// Only needed for loans, which are not used.
void resize_samples(void** /*out*/, const ddsi_sertype* /*type*/, void* /*old*/, std::size_t /*old_count*/,
                    std::size_t /*count*/) {}
void free_samples(const ddsi_sertype* /*type*/, void** /*samples*/, std::size_t /*count*/,
                  dds_free_op_t /*how*/) {}

// The names are already known to be the same.
bool is_equal(const ddsi_sertype* /*a*/, const ddsi_sertype* /*b*/) {
  return true;
}

std::uint32_t hash_of(const ddsi_sertype* /*type*/) {
  return 0;
}

// Cyclone only reads these tables, but one of its functions has a pointer to writable ones.
const ddsi_serdata_ops kDataOperations = [] {
  ddsi_serdata_ops out{};
  out.eqkey = has_equal_key;
  out.get_size = size_of;
  out.from_ser = from_network;
  out.from_ser_iov = from_parts;
  out.from_keyhash = from_key;
  out.from_sample = from_sample;
  out.to_ser = to_bytes;
  out.to_ser_ref = lend_bytes;
  out.to_ser_unref = return_bytes;
  out.to_sample = to_sample;
  out.to_untyped = to_untyped;
  out.untyped_to_sample = untyped_to_sample;
  out.free = free_data;
  out.print = print;
  out.get_keyhash = to_key_hash;
  return out;
}();

const ddsi_sertype_ops kTypeOperations = [] {
  ddsi_sertype_ops out{};
  out.version = ddsi_sertype_v0;
  out.free = free_type;
  out.zero_samples = clear_samples;
  out.realloc_samples = resize_samples;
  out.free_samples = free_samples;
  out.equal = is_equal;
  out.hash = hash_of;
  return out;
}();

}  // namespace

dds_entity_t create_raw_topic(dds_entity_t participant, const std::string& name, const std::string& type) {
  auto made = std::make_unique<ddsi_sertype>();
  ddsi_sertype_init(made.get(), type.c_str(), &kTypeOperations, &kDataOperations, true);
  made->allowed_data_representation = DDS_DATA_REPRESENTATION_FLAG_XCDR1;
  ddsi_sertype* used = made.get();
  const dds_entity_t topic =
      dds_create_topic_sertype(participant, name.c_str(), &used, nullptr, nullptr, nullptr);
  if (topic >= 0) {
    static_cast<void>(made.release());  // Cyclone owns it
  } else {
    ddsi_sertype_unref(made.release());
  }
  return topic;
}

}  // namespace groma::dds
