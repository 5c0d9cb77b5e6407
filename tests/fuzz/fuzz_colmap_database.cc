// COLMAP's database.
#include <sqlite3.h>

#include "pipeline/files.h"
#include "sfm/colmap_database.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {
namespace {

constexpr char kFile[] = "database.db";

}  // namespace

std::vector<std::string> Seeds() {
  const std::filesystem::path file = Folder() / "seed.db";
  sqlite3* database = nullptr;
  Require(sqlite3_open(file.c_str(), &database) == SQLITE_OK, "a database can be made");
  const int status = sqlite3_exec(database,
                                  "PRAGMA page_size = 512;"
                                  "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);"
                                  "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER);"
                                  "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER, data BLOB);"
                                  "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);"
                                  "INSERT INTO images VALUES (1, '000000', 1), (2, '000001', 1);"
                                  "INSERT INTO keypoints VALUES (1, 300);"
                                  "INSERT INTO descriptors VALUES (1, 1, zeroblob(128));"
                                  "INSERT INTO two_view_geometries VALUES (2147483649, 50);",
                                  nullptr, nullptr, nullptr);
  Require(status == SQLITE_OK && sqlite3_close(database) == SQLITE_OK, "a database can be written");
  return {ReadFile(file)};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const std::filesystem::path file = fuzz::Folder() / fuzz::kFile;
  for (const char* suffix : {"-journal", "-wal", "-shm"}) std::filesystem::remove(file.native() + suffix);
  fuzz::Write(fuzz::kFile, {reinterpret_cast<const char*>(data), size});
  fuzz::ParseOrError(file, [&] { return ReadColmapDatabase(file); });
  const auto descriptors = fuzz::ParseOrError(file, [&] { return ReadFeatureDescriptors(file, 1); });
  if (descriptors) fuzz::Require(descriptors->cols() == 128, "every descriptor is one of SIFT");
  return 0;
}
