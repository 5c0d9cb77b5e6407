#include "sfm/colmap_database.h"

#include <sqlite3.h>

#include <algorithm>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

constexpr int64_t kMaxImages =
    2147483647;  // pair_id = kMaxImages · smaller id + larger id (src/base/database.cc of 3.8)

constexpr int kSiftDimension = 128;

class Connection {
 public:
  explicit Connection(const std::filesystem::path& file) : file_(file) {
    // Read-write: an interrupted COLMAP may have left a journal that has to be rolled back.
    if (sqlite3_open_v2(file.c_str(), &database_, SQLITE_OPEN_READWRITE, nullptr) != SQLITE_OK) {
      const std::string reason = sqlite3_errmsg(database_);
      sqlite3_close(database_);
      throw Failure(reason);
    }
  }
  ~Connection() { sqlite3_close(database_); }
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;

  // `bind` sets the query's parameters.
  void ForEachRow(const char* query, const std::function<void(sqlite3_stmt*)>& row,
                  const std::function<void(sqlite3_stmt*)>& bind = {}) {
    sqlite3_stmt* prepared = nullptr;
    int status = sqlite3_prepare_v2(database_, query, -1, &prepared, nullptr);
    const std::unique_ptr<sqlite3_stmt, decltype(&sqlite3_finalize)> statement(prepared, sqlite3_finalize);
    if (status == SQLITE_OK && bind) bind(statement.get());
    while (status == SQLITE_OK || status == SQLITE_ROW) {
      status = sqlite3_step(statement.get());
      if (status == SQLITE_ROW) row(statement.get());
    }
    if (status != SQLITE_DONE) throw Failure(sqlite3_errmsg(database_));
  }

  Error Failure(const std::string& reason) const {
    return CorruptError("cannot read COLMAP's database " + EscapePath(file_) + ": " + EscapePath(reason) +
                        "; remove it and run again");
  }

 private:
  std::filesystem::path file_;
  sqlite3* database_ = nullptr;
};

}  // namespace

ColmapDatabase ReadColmapDatabase(const std::filesystem::path& file) {
  ColmapDatabase result;
  if (!std::filesystem::exists(file)) return result;
  Connection connection(file);
  connection.ForEachRow(
      "SELECT images.image_id, name, camera_id, keypoints.rows FROM images LEFT JOIN keypoints"
      " ON keypoints.image_id = images.image_id",
      [&](sqlite3_stmt* row) {
        const auto* name = reinterpret_cast<const char*>(sqlite3_column_text(row, 1));
        if (name == nullptr) throw connection.Failure("it holds an image without a name");
        const bool extracted = sqlite3_column_type(row, 3) != SQLITE_NULL;
        result.images[uint32_t(sqlite3_column_int64(row, 0))] = {name, uint32_t(sqlite3_column_int64(row, 2)),
                                                                 extracted ? sqlite3_column_int(row, 3) : -1};
      });
  connection.ForEachRow("SELECT pair_id, rows FROM two_view_geometries", [&](sqlite3_stmt* row) {
    const int64_t pair = sqlite3_column_int64(row, 0);
    result.verified_matches[{uint32_t(pair / kMaxImages), uint32_t(pair % kMaxImages)}] = sqlite3_column_int(row, 1);
  });
  return result;
}

FeatureDescriptors ReadFeatureDescriptors(const std::filesystem::path& file, uint32_t image_id) {
  FeatureDescriptors result(0, kSiftDimension);
  Connection connection(file);
  const std::string query = "SELECT rows, data FROM descriptors WHERE image_id = " + std::to_string(image_id);
  connection.ForEachRow(query.c_str(), [&](sqlite3_stmt* row) {
    const int64_t n_features = sqlite3_column_int64(row, 0), n_bytes = sqlite3_column_bytes(row, 1);
    if (n_features < 0 || n_features > n_bytes || n_features * kSiftDimension != n_bytes) {
      throw connection.Failure("image " + std::to_string(image_id) + " has " + std::to_string(n_features) +
                               " descriptors in " + std::to_string(n_bytes) + " bytes, expected " +
                               std::to_string(kSiftDimension) + " bytes each");
    }
    if (n_features > 0) {
      result = Eigen::Map<const FeatureDescriptors>(static_cast<const uint8_t*>(sqlite3_column_blob(row, 1)),
                                                    n_features, kSiftDimension);
    }
  });
  return result;
}

namespace {

// Changes that belong together: what throws leaves them open, and closing the connection rolls them back.
class Transaction {
 public:
  explicit Transaction(const std::filesystem::path& file) : connection_(file) { Run("BEGIN"); }
  void Run(const char* statement, const std::function<void(sqlite3_stmt*)>& bind = {}) {
    connection_.ForEachRow(
        statement, [](sqlite3_stmt*) {}, bind);
  }
  void Commit() { Run("COMMIT"); }

 private:
  Connection connection_;
};

// Model, width, height, params as 1 to 4, `id` as 5.
auto BindCamera(const ColmapCamera& camera, uint32_t id) {
  return [&camera, id](sqlite3_stmt* statement) {
    sqlite3_bind_int(statement, 1, int(camera.model));
    sqlite3_bind_int(statement, 2, camera.width);
    sqlite3_bind_int(statement, 3, camera.height);
    sqlite3_bind_blob(statement, 4, camera.params.data(), int(camera.params.size() * sizeof(double)), SQLITE_TRANSIENT);
    sqlite3_bind_int64(statement, 5, id);
  };
}

}  // namespace

void SetLenses(const std::filesystem::path& file, const std::map<uint32_t, ColmapCamera>& cameras) {
  Transaction transaction(file);
  for (const auto& [id, camera] : cameras) {
    transaction.Run(
        "UPDATE cameras SET model = ?1, width = ?2, height = ?3, params = ?4, prior_focal_length = 1"
        " WHERE camera_id = ?5",
        BindCamera(camera, id));
  }
  transaction.Run("DELETE FROM two_view_geometries");
  transaction.Commit();
}

void SetOwnCameras(const std::filesystem::path& file, const std::map<uint32_t, ColmapCamera>& by_image) {
  const ColmapDatabase database = ReadColmapDatabase(file);
  std::vector<std::string> rig_tables;  // of COLMAP 3.12 on, which makes one of each camera where these are empty
  Connection(file).ForEachRow(
      "SELECT name FROM sqlite_master WHERE name IN ('rigs', 'rig_sensors', 'frames', 'frame_data')",
      [&](sqlite3_stmt* row) { rig_tables.emplace_back(reinterpret_cast<const char*>(sqlite3_column_text(row, 0))); });
  uint32_t next_id = 0;
  for (const auto& [id, image] : database.images) next_id = std::max(next_id, image.camera_id);
  Transaction transaction(file);
  for (const auto& [image, camera] : by_image) {
    transaction.Run(
        "INSERT INTO cameras (model, width, height, params, camera_id, prior_focal_length)"
        " VALUES (?1, ?2, ?3, ?4, ?5, 1)",
        BindCamera(camera, ++next_id));
    transaction.Run("UPDATE images SET camera_id = ?2 WHERE image_id = ?1", [&, image = image](sqlite3_stmt* row) {
      sqlite3_bind_int64(row, 1, image);
      sqlite3_bind_int64(row, 2, next_id);
    });
  }
  for (const std::string& table : rig_tables) transaction.Run(("DELETE FROM " + table).c_str());
  transaction.Commit();
}

}  // namespace nrff
