// Safetensors files: what is written is read back, and nothing that is not whole is read.

#include "model/safetensors.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <fstream>
#include <stdexcept>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "tests/temporary_directory.h"

namespace nrff {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class SafetensorsTest : public ::testing::Test {
 protected:
  std::filesystem::path Path() const { return directory_.path() / "x.safetensors"; }

  // Without the fsync of WriteFileAtomically: some tests write a thousand files.
  void WriteBytes(const std::string& bytes) const { std::ofstream(Path(), std::ios::binary) << bytes; }

  // A file with this header and so many bytes of data.
  void Write(const std::string& header, size_t n_data) const {
    const uint64_t length = header.size();
    std::string bytes(8, '\0');
    std::memcpy(bytes.data(), &length, 8);
    WriteBytes(bytes + header + std::string(n_data, '\1'));
  }

  // The message of the CorruptError that reading ends with.
  std::string Refusal() const {
    try {
      const SafetensorsFile file(Path());
    } catch (const Error& error) {
      EXPECT_EQ(error.code(), ExitCode::kCorrupt);
      EXPECT_THAT(error.what(), HasSubstr("x.safetensors"));
      return error.what();
    }
    ADD_FAILURE() << "was read";
    return {};
  }

  void WriteSample() const {
    const std::vector<float> f{1.5F, -2, 3, 4, 5, 6};
    const std::vector<double> d{0.1};
    const std::vector<uint8_t> u{7, 8, 9};
    const std::vector<int64_t> i{int64_t{1} << 60, -1};
    WriteSafetensors(Path(),
                     {{"f", DType::kF32, {2, 3}, f.data()},
                      {"u", DType::kU8, {3}, u.data()},
                      {"d", DType::kF64, {}, d.data()},
                      {"i", DType::kI64, {2, 1}, i.data()},
                      {"empty", DType::kF32, {0, 4}, nullptr}},
                     {{"key", "line\nbreak ü"}});
  }

  TemporaryDirectory directory_;
};

TEST_F(SafetensorsTest, ReadsBackWhatItWrote) {
  WriteSample();
  const SafetensorsFile file(Path());
  EXPECT_EQ(file.tensors().size(), 5U);
  EXPECT_THAT(file.Values<float>("f", {2, 3}), ElementsAre(1.5F, -2, 3, 4, 5, 6));
  EXPECT_THAT(file.Values<double>("d", {}), ElementsAre(0.1));
  EXPECT_THAT(file.Values<uint8_t>("u"), ElementsAre(7, 8, 9));
  EXPECT_THAT(file.Values<int64_t>("i"), ElementsAre(int64_t{1} << 60, -1));
  EXPECT_TRUE(file.Values<float>("empty", {0, 4}).empty());
  EXPECT_EQ(file.Metadata("key"), "line\nbreak ü");
}

TEST_F(SafetensorsTest, StartsDataAlignedWithWideTypesFirst) {
  WriteSample();
  const std::string bytes = ReadFile(Path());
  uint64_t length = 0;
  std::memcpy(&length, bytes.data(), 8);
  EXPECT_EQ(length % 8, 0U);
  double first = 0;
  std::memcpy(&first, bytes.data() + 8 + length, 8);
  EXPECT_EQ(first, 0.1);
}

TEST_F(SafetensorsTest, NamesWhatIsMissingOrOfAnotherKind) {
  WriteSample();
  const SafetensorsFile file(Path());
  EXPECT_THROW(file.Get("g"), Error);
  EXPECT_THROW(file.Metadata("g"), Error);
  EXPECT_THROW(file.Values<double>("f"), Error);
  EXPECT_THROW(file.Values<float>("f", {3, 2}), Error);
}

TEST_F(SafetensorsTest, RefusesAFileCutAtAnyByte) {
  WriteSample();
  const std::string bytes = ReadFile(Path());
  for (size_t length = 0; length < bytes.size(); ++length) {
    WriteBytes(bytes.substr(0, length));
    EXPECT_THAT(Refusal(), HasSubstr("damaged")) << length;
  }
  WriteBytes(bytes + "x");
  EXPECT_THAT(Refusal(), HasSubstr("end at byte"));
}

TEST_F(SafetensorsTest, SurvivesAnyByteOfTheHeaderChanged) {
  WriteSample();
  const std::string bytes = ReadFile(Path());
  uint64_t length = 0;
  std::memcpy(&length, bytes.data(), 8);
  for (size_t i = 0; i < 8 + length; ++i) {
    for (const unsigned char flip : {0x01, 0x10, 0x80}) {
      std::string changed = bytes;
      changed[i] = char(changed[i] ^ flip);
      WriteBytes(changed);
      try {
        const SafetensorsFile file(Path());
        for (const auto& [name, tensor] : file.tensors()) {
          EXPECT_LE(tensor.n_bytes(), bytes.size());
        }
      } catch (const Error& error) {
        EXPECT_EQ(error.code(), ExitCode::kCorrupt);
      }
    }
  }
}

TEST_F(SafetensorsTest, RefusesHeadersThatDoNotDescribeTheData) {
  const std::string a = R"("a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]})";
  const struct {
    std::string header;
    size_t n_data;
    const char* what;
  } cases[] = {
      {"[]", 0, "not a JSON object"},
      {"{" + a + "," + a + "}", 8, "twice"},
      {R"({"a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]}})", 8, "needs 12 bytes but has 8"},
      {R"({"a":{"dtype":"BF16","shape":[4],"data_offsets":[0,8]}})", 8, "the type"},
      {R"({"a":{"shape":[2],"data_offsets":[0,8]}})", 8, "the type null"},
      {R"({"a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}})", 8, "not a size"},
      {R"({"a":{"dtype":"F32","shape":[2.0],"data_offsets":[0,8]}})", 8, "not a size"},
      {R"({"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,8]}})", 8, "impossible shape"},
      {R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}})", 8, "should lie at"},
      {R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8,8]}})", 8, "should lie at"},
      {R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})", 8, "should lie at"},
      {"{" + a + R"(,"b":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}})", 8, "ends at"},
      {"{" + a + R"(,"b":{"dtype":"F32","shape":[1],"data_offsets":[12,16]}})", 16, "ends at 8"},
      {"{" + a + "}", 12, "end at byte 8 of 12"},
      {"{\"\xff\":{}}", 0, "not valid JSON"},
      {R"({"__metadata__":{"k":1}})", 0, "not text"},
      {R"({"a":7})", 8, "not an object"},
      {std::string(100000, '['), 0, "not valid JSON"},
  };
  for (const auto& [header, n_data, what] : cases) {
    Write(header, n_data);
    EXPECT_THAT(Refusal(), HasSubstr(what)) << header.substr(0, 100);
  }
}

TEST_F(SafetensorsTest, RefusesAHeaderLongerThanTheFileBeforeTakingMemory) {
  std::string bytes(16, '\xff');
  WriteBytes(bytes);
  EXPECT_THAT(Refusal(), HasSubstr("should have 18446744073709551615 bytes"));
}

TEST_F(SafetensorsTest, SaysThatAnAbsentFileIsAbsent) {
  try {
    const SafetensorsFile file(Path());
    FAIL();
  } catch (const Error& error) {
    EXPECT_EQ(error.code(), ExitCode::kInput);
  }
}

TEST_F(SafetensorsTest, WritesNoNameTwice) {
  const float x = 1;
  EXPECT_THROW(WriteSafetensors(Path(), {{"a", DType::kF32, {1}, &x}, {"a", DType::kF32, {1}, &x}}),
               std::invalid_argument);
  EXPECT_FALSE(std::filesystem::exists(Path()));
}

}  // namespace
}  // namespace nrff
