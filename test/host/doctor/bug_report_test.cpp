// groma bugreport: its archive opens by tar, has all parts, and no secret.
#include "host/doctor/bug_report.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "host/io/exit_code.hpp"
#include "test/host/doctor/doctor_fixture.hpp"

namespace groma::doctor {
namespace {

using daemon::Gromad;
using daemon::SimulatedSite;
using groma::test::read_text;
using groma::test::run_child;
using ::testing::HasSubstr;
using ::testing::Not;

constexpr const char* kKey = "00112233445566778899aabbccddeeff";

TEST(WithoutSecrets, RemovesThemAndNothingElse) {
  const std::vector<std::pair<std::string, std::string>> cases{
      {"key: s3cret", "key: [removed]"},
      {"  network_key: 'a, b'  # note", "  network_key: [removed]  # note"},
      {"password: two words, and more", "password: [removed]"},
      {R"({"token": "abc", "id": 7})", R"({"token": [removed], "id": 7})"},
      {"mqtt: {user: a, password: b}", "mqtt: {user: a, password: [removed]}"},
      {"API_KEY=abc def", "API_KEY=[removed]"},
      {"secret: [1, 2, 3]", "secret: [removed]"},
      {"# old key: 1234", "# old key: [removed]"},
      {"token_file: /etc/groma/token", "token_file: /etc/groma/token"},
      {"unknown key 'modle'", "unknown key 'modle'"},
      {"x 0x00112233445566778899aabbccddeeff y", "x 0x[removed] y"},
      {"site-00112233445566778899aabbccddeeff", "site-[removed]"},
      {"is 00:11:22:33:44:55:66:77:88:99:aa:bb:cc:dd:ee:ff.", "is [removed]."},
      {"loaded 0011 2233 4455 6677 8899 aabb ccdd eeff", "loaded [removed]"},
      {"is 00 11 22 33 44 55 66 77 88 99 aa bb cc dd ee ff", "is [removed]"},
      {"input_sha256: 00112233445566778899aabbccddeeff", "input_sha256: 00112233445566778899aabbccddeeff"},
      {"2026-11-26T22:36:01 x: 1.2345678901234567, 0.1", "2026-11-26T22:36:01 x: 1.2345678901234567, 0.1"},
      {"web: https://user:pass@host/a?b", "web: https://[removed]@host/a?b"},
      {"path: tcp://10.0.0.7:4001", "path: tcp://10.0.0.7:4001"},
      {"keys:\n  - one\n  - two\nnodes: 3\n", "keys:[removed]\nnodes: 3\n"},
      {"key: |\n  one\n\n  two\nnodes: 3", "key: [removed]\nnodes: 3"},
      {"{\n  \"tokens\": {\n    \"a\": 1\n  },\n  \"b\": 2", "{\n  \"tokens\": [removed]\n  },\n  \"b\": 2"},
      {"a\n-----BEGIN PRIVATE KEY-----\nMIIB\n-----END PRIVATE KEY-----\nb\n", "a\n[removed]\nb\n"},
      {"", ""},
      {"\n", "\n"}};
  for (const auto& [text, expected] : cases) EXPECT_EQ(without_secrets(text), expected) << text;
}

TEST(TarArchive, OpensByTar) {
  const groma::test::TemporaryFolder folder;
  const std::string exact(1024, 'x');
  folder.write("a.tar", tar_archive("f", {{"one", "text\n"}, {"empty", ""}, {"exact", exact}}));
  const auto tar = run_child({"/bin/tar", "-C", folder.path(), "-xvf", folder / "a.tar"});
  EXPECT_EQ(tar.exit_code, 0) << tar.err;
  EXPECT_EQ(tar.err, "");
  EXPECT_EQ(tar.out, "f/one\nf/empty\nf/exact\n");
  EXPECT_EQ(read_text(folder / "f/one"), "text\n");
  EXPECT_EQ(read_text(folder / "f/empty"), "");
  EXPECT_EQ(read_text(folder / "f/exact"), exact);
}

class BugReport : public daemon::DoctorTest {
 protected:
  [[nodiscard]] std::string part(const std::string& name) const {
    return read_text(folder_ / "groma-bugreport" / name);
  }
};

TEST_F(BugReport, HasAllPartsAndNoKey) {
  SimulatedSite site(folder_.path(), daemon::kSpeed);
  write_surveyed(site);
  const auto config = write_config("{file: calibration.yaml}",
                                   fmt::format("web: {{port: {}}}\n# key: {}\n", free_port(), kKey));
  std::ofstream(folder_ / "calibration.yaml", std::ios::app) << "# " << kKey << "\n";
  Gromad gromad({"--config", config.string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") > 0; })) << gromad.log();
  client_.reset();
  folder_.write("gromad.log", gromad.log() + "loaded " + kKey + "\n");
  const auto result = run_beside(site, {GROMA_PATH, "bugreport", "--config", config, "--log",
                                        folder_ / "gromad.log", "-o", folder_ / "report.tar"});
  ASSERT_EQ(result.exit_code, io::kGood) << result.err;
  ASSERT_THAT(read_text(folder_ / "gromad.yaml"), HasSubstr(kKey));
  EXPECT_THAT(read_text(folder_ / "report.tar"), Not(HasSubstr(kKey)));
  const auto tar = run_child({"/bin/tar", "-C", folder_.path(), "-xf", folder_ / "report.tar"});
  ASSERT_EQ(tar.exit_code, 0) << tar.err;
  EXPECT_THAT(part("version.txt"), testing::ContainsRegex("^groma [0-9.]+\ngromad [0-9.]+\nsystem Linux"));
  EXPECT_THAT(part("gromad.yaml"), HasSubstr("# key: [removed]"));
  EXPECT_THAT(part("calibration.yaml"), HasSubstr("verdict: usable"));
  EXPECT_THAT(part("status.jsonl"), HasSubstr(R"("class":"STATUS")"));
  EXPECT_THAT(part("metrics.txt"), HasSubstr("groma_state"));
  EXPECT_THAT(part("log.txt"), HasSubstr("pose stream on"));
  EXPECT_THAT(part("log.txt"), HasSubstr("loaded [removed]"));
  EXPECT_THAT(part("doctor.txt"), HasSubstr("good     link"));
  EXPECT_EQ(nlohmann::json::parse(part("doctor.json")).at("verdict"), "good");
}

TEST_F(BugReport, IsWrittenWithoutGromadToo) {
  const auto result =
      run_child({GROMA_PATH, "bugreport", "--config", folder_ / "none.yaml", "-o", folder_ / "a.tar"});
  ASSERT_EQ(result.exit_code, io::kGood) << result.err;
  ASSERT_EQ(run_child({"/bin/tar", "-C", folder_.path(), "-xf", folder_ / "a.tar"}).exit_code, 0);
  EXPECT_THAT(part("version.txt"), HasSubstr("gromad does not answer"));
  EXPECT_THAT(part("gromad.yaml"), HasSubstr("does not exist"));
  EXPECT_FALSE(part("log.txt").empty());
  const auto unwritable =
      run_child({GROMA_PATH, "bugreport", "--config", folder_ / "none.yaml", "-o", folder_ / "no/a.tar"});
  EXPECT_EQ(unwritable.exit_code, io::kUsage);
}

}  // namespace
}  // namespace groma::doctor
